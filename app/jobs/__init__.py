"""Long work: one job at a time, in a thread of its own, that can be watched, paused and stopped."""
