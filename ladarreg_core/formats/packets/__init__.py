"""Recorded packets of spinning sensors."""
