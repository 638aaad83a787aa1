"""Results written to files, one target a file."""
