"""Whole scans of several stations, registered to each other by their ranges: search, alignment, verdict, network."""
