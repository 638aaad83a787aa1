"""The correspondence chain of the thesis (1998)."""
