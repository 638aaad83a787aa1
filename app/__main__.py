"""`python -m app` is the command line."""

from app.cli import entry_point

entry_point()
