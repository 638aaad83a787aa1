"""E57 files: pages, trees, records."""
