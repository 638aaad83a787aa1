"""One module per command: its `Arguments`, and `run(arguments) -> ExitCode`."""
