"""The exit codes of the command line."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of the process."""

    ACCEPTED = 0
    """Success; a registration was accepted."""
    FAILED = 1
    """A bug, or work that could not be saved."""
    BAD_INPUT = 2
    """Unusable input or arguments."""
    NOT_ACCEPTED = 3
    """The registration finished, but its evidence is insufficient."""
    INTERRUPTED = 130
    """Interrupted by the user; no incomplete files are left."""
