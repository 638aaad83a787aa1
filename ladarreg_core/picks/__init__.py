"""Drawn points and lines, measured on the scan as matches for the solvers."""
