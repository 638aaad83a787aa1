"""A run of stops: its runner, its folder, its pieces."""
