"""Entry point of `python -m ladarreg`."""

from .cli import entry_point

entry_point()
