"""What the command line answers to a script."""

from enum import IntEnum


class ExitCode(IntEnum):
    """The process's exit codes."""

    ACCEPTED = 0
    """Done; a registration was accepted."""
    FAILED = 1
    """A fault of the program, or work that could not be saved."""
    BAD_INPUT = 2
    """Input or arguments that cannot be used."""
    NOT_ACCEPTED = 3
    """The registration ran to its end, and its evidence is not enough."""
    INTERRUPTED = 130
    """Stopped by the user; nothing half-made is left."""
