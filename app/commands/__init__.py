"""One file a command: its `Arguments`, and `run(arguments) -> ExitCode`."""
