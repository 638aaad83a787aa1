"""The one export: `pipeline` writes targets, `registry` lists them, one writer a file."""
