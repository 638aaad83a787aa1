"""Surveys: many photographs, several scans and cameras, solved together, each with a verdict."""
