"""What tests and benchmarks share: scenes with known truth, files, a served workbench with its operator, attacks."""
