"""What the two characters of a SCIP 2 status mean, which depends on the command.

Source: the SCIP 2.0 specification, sections 8 and 9.
"""

from __future__ import annotations

UNKNOWN_COMMAND = ("0C", "0D", "0E", "0F")
"""Statuses of a command that the scanner does not have; some firmware finds its parameters wrong first."""
_STEPS = {
    "01": "a start step that is no number",
    "02": "an end step that is no number",
    "03": "a cluster count that is no number",
    "04": "an end step beyond its range",
    "05": "an end step before the start step",
}
_MEANINGS = {
    "G": _STEPS | {"10": "that its laser is off"},
    "M": _STEPS | {"06": "an interval that is no number", "07": "a number of lines that is no number"},
    "BM": {"01": "that its laser does not work", "02": "that its laser is on already"},
    "TM": {
        "01": "that it does not know this mode",
        "02": "that its clock is being compared already",
        "03": "that its clock is not being compared",
        "04": "that its clock is not being compared",
    },
}
_OF_ALL = {
    "0A": "that it cannot make an answer",
    "0B": "that it is still busy with an earlier command",
    "0C": "that parameters are missing",
    "0D": "that it does not know the command",
    "0E": "that it does not know the command",
    "0F": "that parameters are missing",
    "0G": "that the command is too long",
    "0H": "that the command has characters that it does not accept",
    "0I": "that its firmware is being updated: switch it off and on",
}
_VERIFIES, _HARDWARE = range(21, 50), range(50, 98)
_RESUMES = "98"


def is_passing(status: str, sent: bytes) -> bool:
    """Return whether a status says that the scanner is not ready yet: it verifies an error, or has just done so.

    Args:
        status: the two characters.
        sent: the command.
    """
    verifies = sent[:1] == b"M" and status.isdigit() and int(status) in _VERIFIES
    return verifies or (status == _RESUMES and sent[:1] in (b"G", b"M"))


def status_in_words(status: str, sent: bytes) -> str:
    """Return what a status says, to follow `answered`.

    Args:
        status: the two characters.
        sent: the command.
    """
    command = sent[:2].decode("ascii", "replace")
    number = int(status) if status.isascii() and status.isdigit() else -1
    if is_passing(status, sent):
        return (
            f"that it does not measure yet ({status}): it verifies its laser and its motor; if that does not end, "
            "switch it off and on, and keep it from vibrating"
        )
    if number in _HARDWARE or status == _RESUMES:
        return f"a fault of its hardware ({status}): switch it off and on, and have it repaired if that does not help"
    if number in _VERIFIES:
        return f"a fault of its own ({status}): switch it off and on"
    meanings = _MEANINGS.get(command, {}) if command in _MEANINGS else _MEANINGS.get(command[:1], {})
    if meaning := meanings.get(status, _OF_ALL.get(status)):
        return f"{meaning} ({status})"
    return f"the status {status}, which the protocol does not have for this command"
