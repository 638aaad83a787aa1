"""Export of results to files, one module per format."""
