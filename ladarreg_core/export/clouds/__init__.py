"""Clouds of points as files: their rows, PLY, LAS."""
