"""The reader processes of the workbench: no file that somebody opens in the page is decoded in the server itself."""

from __future__ import annotations

from ladarreg_core.formats.isolated import IsolatedReaders

READERS = IsolatedReaders()
"""Shared by all that this process opens; the commands without a page read directly, as a crash ends nobody else."""
