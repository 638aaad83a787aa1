"""What is drawn by hand in several photographs of a project, ties and lines, and how the last adjustment judged it."""

from __future__ import annotations

import msgspec

from ladarreg_core.project.source import Source

Pixel = tuple[float, float]
Place = tuple[float, float, float]


class TieEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A point marked by hand in the two photographs that show it."""

    id: str
    """Stable id of letters and digits."""
    photos: tuple[str, str]
    """Ids of the photographs."""
    uv: tuple[tuple[float, float], tuple[float, float]]
    """Where each shows it, px."""
    sigma_px: float
    """Standard deviation of each of these."""


class AdjustedTieEntry(msgspec.Struct, frozen=True, kw_only=True):
    """How an adjustment judged a drawn tie."""

    agrees: bool
    """Whether it was kept."""
    residual_px: float | None = None
    """The larger of its two residuals, px; None: it was no part of it."""
    reason: str = ""
    """A sentence."""


class ScanLineEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A line as a scan shows it."""

    source: Source
    """The scan's file."""
    xyz: tuple[Place, Place]
    """Two places of it, scanner frame, m."""
    sigma_m: float
    """Standard deviation of each across it."""


class LineEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A straight edge drawn by hand in one photograph after the other."""

    id: str
    """Stable id of letters and digits."""
    photos: tuple[str, ...]
    """Ids of the photographs; none where a scan alone shows it yet."""
    uv: tuple[tuple[Pixel, Pixel], ...]
    """Two places of it in each, px."""
    sigma_px: float
    """Standard deviation of each of these, across it."""
    in_scan: ScanLineEntry | None = None
    """The same edge in a scan."""


class AdjustedLineEntry(msgspec.Struct, frozen=True, kw_only=True):
    """How an adjustment judged a drawn line."""

    line: LineEntry
    """The line as it was then."""
    agrees: bool
    """Whether all of it was kept."""
    residuals_px: dict[str, float] = {}
    """How far it lies off in each photograph in which it took part, by their ids, px."""
    scan_residual_m: float | None = None
    """The same in its scan, m; None: it took no part there."""
    reason: str = ""
    """A sentence."""
