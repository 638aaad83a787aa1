"""Poses proposed: hypotheses from features, and searches over views and faces."""
