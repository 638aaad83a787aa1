"""Acquisition: pan/tilt units, line scanners and cameras driven by a plan, and the pieces that a run collects."""
