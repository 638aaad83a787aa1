"""Pictures that are written beside results."""
