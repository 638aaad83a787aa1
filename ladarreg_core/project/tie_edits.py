"""Edits of the ties of a document: places that two of its photographs show, as somebody drew them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from msgspec.structs import replace

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document, TieEntry
from ladarreg_core.project.edits import MAX_PIXEL, finite, require_photo

MAX_TIES = 2000
"""Most ties of a project."""
_LARGEST_SIGMA_PX = 100.0
"""Of a tie: it would say nothing."""


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
