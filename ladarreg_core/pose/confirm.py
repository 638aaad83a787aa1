"""A pose that its matches accept, asked again from many starts before it is believed."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ladarreg_core.frames import Rigid
from ladarreg_core.pose.multistart import BasinVerdict, probe_basin
from ladarreg_core.results import PoseResult


@dataclass(frozen=True, slots=True, eq=False)
class Confirmation:
    """What many starts made of a result."""

    result: PoseResult
    """The result with their verdict in its reasons and its diagnostics."""
    verdict: BasinVerdict | None
    """`unique`, `ambiguous` or `failed`; None where nothing was accepted that could be confirmed."""
    better: Rigid | None = None
    """A pose that explains the matches better, to solve again from."""


def confirm(result: PoseResult, *, starts: int = 32, seed: int = 0) -> Confirmation:
    """Probe the basin of an accepted pose; where another pose explains the matches too, it is accepted no more.

    Args:
        result: a pose with its matches. What is not accepted is returned as it is.
        starts: how many starts, at least.
        seed: of the starts.

    Raises:
        OptionError: if the starts or the seed have no meaning.
    """
    if not result.accepted:
        return Confirmation(result, None)
    basin = probe_basin(result, starts=starts, seed=seed)
    diagnostics = {**result.diagnostics, "basin": basin.as_dict()}
    if basin.verdict == "unique":
        confirmed = replace(result, reasons=(*result.reasons, basin.in_words()), diagnostics=diagnostics)
        return Confirmation(confirmed, basin.verdict)
    refused = replace(
        result, accepted=False, evidence="none", reasons=(basin.in_words(),), diagnostics=diagnostics
    )  # fmt: skip
    better = basin.other if basin.verdict == "failed" else None
    return Confirmation(refused, basin.verdict, better)
