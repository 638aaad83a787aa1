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
    """It finished and was written, but is not accepted: too little evidence, or pieces that do not fit."""
    UNDECIDABLE = 4
    """An audit: the images cannot decide whether the pose is right."""
    INTERRUPTED = 130
    """Interrupted by the user; no incomplete files are left."""
