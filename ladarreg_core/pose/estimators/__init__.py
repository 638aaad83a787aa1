"""Estimators of a pose: robust, by sampling, and by bundle adjustment."""
