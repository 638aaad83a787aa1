"""Rigs: a scanner and a camera that are mounted together, their one pose solved from pairs taken at several places."""
