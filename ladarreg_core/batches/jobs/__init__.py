"""Many jobs in one run: pairs, photographs of a scan, and surveys, on processes or a cluster."""
