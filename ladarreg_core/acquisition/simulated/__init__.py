"""Twins: simulated pan/tilt units, scanners and cameras in a simulated room, behind real ports."""
