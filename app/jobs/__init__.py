"""Long-running work, one job at a time: matching, solving, registration, self-test, export."""
