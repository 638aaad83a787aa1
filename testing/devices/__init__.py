"""Simulated devices without real time: a clock that only waiting moves, and ports in memory."""
