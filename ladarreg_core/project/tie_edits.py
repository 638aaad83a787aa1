"""Edits of what is drawn by hand in several photographs of a document: ties and lines."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import OptionError
from ladarreg_core.matches import MIN_LINE_PX
from ladarreg_core.project.document import Document
from ladarreg_core.project.drawn import LineEntry, ScanLineEntry, TieEntry
from ladarreg_core.project.edits import MAX_PIXEL, finite, require_photo

MAX_TIES = 2000
"""Most ties of a project, and most lines."""
_LARGEST_SIGMA_PX = 100.0
"""Of a tie: it would say nothing."""
_LARGEST_SIGMA_M = 1000.0
"""Likewise of a line in a scan."""


def with_tie(
    document: Document, photos: Sequence[object], uv: Sequence[Sequence[object]], sigma_px: object
) -> tuple[Document, TieEntry]:
    """Return the document with a further tie, and that.

    Args:
        document: the document.
        photos: ids of two photographs.
        uv: a pixel [u, v] in each.
        sigma_px: standard deviation of each of these.

    Raises:
        OptionError: if they are not two photographs of the project, or not two pixels near them; if the standard
            deviation is none; or if there are too many ties.
    """
    if len(document.ties) >= MAX_TIES:
        raise OptionError(f"the project has {MAX_TIES:,} ties, which is the maximum; remove some first")
    number = document.numbered_ties + 1
    first, second = (require_photo(document, one).id for one in _two(photos, "photos"))
    new = checked_tie(
        TieEntry(
            id=f"t{number}", photos=(first, second), uv=(_pixel(uv[0]), _pixel(_two(uv, "pixels")[1])),
            sigma_px=_number(sigma_px, "sigma_px"),
        )
    )  # fmt: skip
    return replace(document, ties=(*document.ties, new), numbered_ties=number), new


def without_ties(document: Document, ids: Collection[str]) -> Document:
    """Return the document without some ties."""
    return replace(document, ties=tuple(each for each in document.ties if each.id not in ids))


def checked_tie(entry: TieEntry) -> TieEntry:
    """Return a tie that is sound.

    Raises:
        OptionError: if it is of one photograph alone, or a pixel or the standard deviation is none.
    """
    if entry.photos[0] == entry.photos[1]:
        raise OptionError("both ends of the tie are in the same photograph; draw it to another one")
    for uv in entry.uv:
        _pixel(uv)
    if not 0 < _number(entry.sigma_px, "sigma_px") <= _LARGEST_SIGMA_PX:
        raise OptionError(
            f"the tie's standard deviation is {entry.sigma_px:g} px; it must be positive, {_LARGEST_SIGMA_PX:g} at most"
        )
    return entry


def with_line(
    document: Document, photos: Sequence[object], uv: Sequence[Sequence[Sequence[object]]], sigma_px: object,
    in_scan: ScanLineEntry | None = None,
) -> tuple[Document, LineEntry]:  # fmt: skip
    """Return the document with a further line, and that.

    Args:
        document: the document.
        photos: ids of the photographs that show it.
        uv: two pixels [u, v] in each.
        sigma_px: standard deviation of each of these, across the line.
        in_scan: the same edge in a scan.

    Raises:
        OptionError: if they are no photographs of the project, or no two pixels in each; if the standard deviation is
            none; or if there are too many lines.
    """
    if len(document.lines) >= MAX_TIES:
        raise OptionError(f"the project has {MAX_TIES:,} lines, which is the maximum; remove some first")
    number = document.numbered_lines + 1
    new = checked_line(
        LineEntry(
            id=f"l{number}", photos=tuple(require_photo(document, one).id for one in photos),
            uv=tuple(_ends(one) for one in uv), sigma_px=_number(sigma_px, "sigma_px"), in_scan=in_scan,
        )
    )  # fmt: skip
    return replace(document, lines=(*document.lines, new), numbered_lines=number), new


def with_line_in(document: Document, line: object, photo: object, uv: Sequence[Sequence[object]]) -> Document:
    """Return the document with a line drawn in a further photograph, or once more in one that shows it already.

    Raises:
        OptionError: if there is no such line or photograph, or these are no two pixels.
    """
    found = require_line(document, line)
    shown = dict(zip(found.photos, found.uv, strict=True)) | {require_photo(document, photo).id: _ends(uv)}
    changed = checked_line(replace(found, photos=tuple(shown), uv=tuple(shown.values())))
    return replace(document, lines=tuple(changed if one.id == found.id else one for one in document.lines))


def with_line_in_scan(
    document: Document, line: object, in_scan: ScanLineEntry, sigma_px: object
) -> tuple[Document, LineEntry]:
    """Return the document with a line as a scan shows it, in place of what one showed of it so far, and that line.

    Args:
        document: the document.
        line: id of the line; None: a further one, which photographs are to show later.
        in_scan: the edge in a scan.
        sigma_px: as of `with_line`, of a further line.

    Raises:
        OptionError: if there is no such line, or there are too many.
    """
    if line is None:
        return with_line(document, [], [], sigma_px, in_scan)
    changed = checked_line(replace(require_line(document, line), in_scan=in_scan))
    return replace(document, lines=tuple(changed if one.id == line else one for one in document.lines)), changed


def without_line_in(document: Document, line: object, photo: object) -> Document:
    """Return the document without what one picture shows of a line; without the line if no other one shows it.

    Args:
        document: the document.
        line: id of the line.
        photo: id of a photograph; None: its scan.

    Raises:
        OptionError: if there is no such line, or it is not drawn there.
    """
    found = require_line(document, line)
    if photo is None:
        if found.in_scan is None:
            raise OptionError("the line is not drawn in a scan")
        changed = replace(found, in_scan=None)
    else:
        if photo not in found.photos:
            raise OptionError("the line is not drawn in that photograph")
        shown = [(one, uv) for one, uv in zip(found.photos, found.uv, strict=True) if one != photo]
        changed = replace(found, photos=tuple(one for one, _ in shown), uv=tuple(uv for _, uv in shown))
    if not changed.photos and changed.in_scan is None:
        return without_lines(document, [found.id])
    return replace(document, lines=tuple(changed if one.id == found.id else one for one in document.lines))


def with_line_as_ties(document: Document, line: object) -> Document:
    """Return the document with two ties, of the ends of a line in its two photographs, in place of the line.

    Raises:
        OptionError: if there is no such line, or more or fewer photographs show it.
    """
    found = require_line(document, line)
    if len(found.photos) != 2:
        raise OptionError(
            f"the line is drawn in {len(found.photos)} photograph{'s' if len(found.photos) > 1 else ''}; its ends are "
            "ties where exactly two show both"
        )
    document = without_lines(document, [found.id])
    for end in range(2):
        document, _ = with_tie(document, found.photos, [one[end] for one in found.uv], found.sigma_px)
    return document


def without_lines(document: Document, ids: Collection[str]) -> Document:
    """Return the document without some lines."""
    return replace(document, lines=tuple(each for each in document.lines if each.id not in ids))


def require_line(document: Document, line: object) -> LineEntry:
    """Return a line by its id.

    Raises:
        OptionError: if there is none.
    """
    found = next((one for one in document.lines if one.id == line), None)
    if found is None:
        raise OptionError("the line is no longer in the project")
    return found


def checked_line(entry: LineEntry) -> LineEntry:
    """Return a line that is sound.

    Raises:
        OptionError: if it is twice in one photograph or in no picture, too short, or a number is none.
    """
    if (
        not (entry.photos or entry.in_scan)
        or len(set(entry.photos)) < len(entry.photos)
        or len(entry.uv) != len(entry.photos)
    ):
        raise OptionError("a line is drawn in each of its photographs once; draw it in a picture or more")
    for ends in entry.uv:
        first, second = _ends(ends)
        if np.hypot(second[0] - first[0], second[1] - first[1]) < MIN_LINE_PX:
            raise OptionError(
                f"the line is shorter than {MIN_LINE_PX:g} px, so its direction is unknown; draw it longer"
            )
    if not 0 < _number(entry.sigma_px, "sigma_px") <= _LARGEST_SIGMA_PX:
        raise OptionError(
            f"the line's standard deviation is {entry.sigma_px:g} px; it must be positive, {_LARGEST_SIGMA_PX:g} at "
            "most"
        )
    if entry.in_scan is not None and not 0 < _number(entry.in_scan.sigma_m, "sigma_m") <= _LARGEST_SIGMA_M:
        raise OptionError(
            f"the line's standard deviation in its scan is {entry.in_scan.sigma_m:g} m; it must be positive, "
            f"{_LARGEST_SIGMA_M:g} at most"
        )
    return entry


def _ends(uv: object) -> tuple[tuple[float, float], tuple[float, float]]:
    ends = list(uv) if isinstance(uv, list | tuple) else []
    if len(ends) != 2:
        raise OptionError("a line has two ends in a photograph, [[u, v], [u, v]]; draw both")
    return _pixel(ends[0]), _pixel(ends[1])


def _two(values: Sequence[object], what: str) -> Sequence[object]:
    if len(values) != 2:
        raise OptionError(f"a tie has {len(values)} {what}; it needs two")
    return values


def _number(value: object, name: str) -> float:
    found = finite(value)
    if found is None:
        raise OptionError(f"the tie's {name} is no number; give one")
    return float(found)


def _pixel(uv: object) -> tuple[float, float]:
    values = list(uv) if isinstance(uv, list | tuple) else []
    if len(values) != 2:
        raise OptionError("an end of the tie is no pixel; it is [u, v]")
    u, v = (_number(value, "pixel") for value in values)
    if max(abs(u), abs(v)) > MAX_PIXEL:
        raise OptionError(f"an end lies more than {MAX_PIXEL:,.0f} px from the image's corner; pick in the image")
    return u, v
