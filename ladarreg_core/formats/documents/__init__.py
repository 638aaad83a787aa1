"""Matches, poses and results as files."""
