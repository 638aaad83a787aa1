"""The robustness benchmark of the workbench: `python -m benchmarks.abuse`."""
