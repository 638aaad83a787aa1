"""Pieces composed into one panorama."""
