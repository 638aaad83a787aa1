"""Readers of scans and clouds, a module per format."""
