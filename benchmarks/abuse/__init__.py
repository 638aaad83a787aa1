"""The long attack on the workbench: `python -m benchmarks.abuse`."""
