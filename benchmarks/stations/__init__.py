"""Stations registered to each other, by surfaces and by targets: `python -m benchmarks.stations`."""
