"""The reader processes of the workbench: the server itself decodes no file that a client opens."""

from __future__ import annotations

from ladarreg_core.formats.isolated import IsolatedReaders

READERS = IsolatedReaders()
"""Shared by the whole process; commands without a page read directly, as a crash there affects nobody else."""
