"""`python -m ladarreg` is the command line."""

from .cli import entry_point

entry_point()
