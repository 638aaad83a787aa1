"""Whether images agree at a pose: evidence, and verdicts on it."""
