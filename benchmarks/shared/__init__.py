"""What several benchmarks share: bars, plots, and a panorama."""
