"""The chain of 1998: its estimators and its matching."""
