"""Bounded reading of untrusted bytes: budgets, JSON, XML, YAML, rows of numbers."""
