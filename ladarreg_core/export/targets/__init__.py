"""Exports to other programs: `hand_over` writes them, `registry` lists the targets, one writer a file."""
