"""What an operator looks at: pictures of the scan, overlays, what a pose says of picks, their partners."""
