"""Pan/tilt units, scanners and cameras: protocols, links and ports."""
