"""Scenes, scans and matches with known truth."""
