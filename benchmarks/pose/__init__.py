"""How good the estimators of a pose are, beside their peers."""
