"""Readers of cameras, a module per program's format."""
