"""Long-running work, one job after the other: matching, solving, registration, self-test, export."""
