"""Scans aligned by their ranges: the mount of a scanner on its unit, the pieces of a mosaic, whole stations."""
