"""Readers that run in a process of their own; see `readers`."""

from ladarreg_core.formats.isolated.confinement import confinement as confinement
from ladarreg_core.formats.isolated.readers import IsolatedReaders as IsolatedReaders
from ladarreg_core.formats.isolated.readers import ReaderLimits as ReaderLimits
