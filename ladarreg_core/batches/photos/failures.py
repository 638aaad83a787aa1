"""Why a task failed, in words for users."""

from __future__ import annotations

from ladarreg_core.errors import LadarregError

_NO_MEMORY = ("bad_alloc", "insufficient memory", "cannot allocate memory")
_MAX_CAUSES = 20  # causes of errors can be circular


def failed(why: str, what: str) -> dict[str, object]:
    """Return what a summary says of a task that failed; `what` could not be done."""
    return {"accepted": False, "evidence": "none", "verdict": f"Failed: it could not be {what}.", "reasons": [why]}


def why_it_failed(error: BaseException) -> str:
    """Return why a task failed."""
    if lacks_memory(error):
        return "there was not enough memory"
    if isinstance(error, LadarregError):
        return str(error)
    return f"internal error ({type(error).__name__}: {error}): a fault of this program, not of the file"


def lacks_memory(error: BaseException | None) -> bool:
    """Return whether an error, or what caused it, says that there is no memory left."""
    for _ in range(_MAX_CAUSES):
        if error is None:
            return False
        if isinstance(error, MemoryError) or any(words in str(error).lower() for words in _NO_MEMORY):
            return True
        error = error.__cause__ or error.__context__
    return False
