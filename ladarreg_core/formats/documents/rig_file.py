"""The table of a rig: a CSV with a scan and a photograph in each row."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.csv_table import read_csv_table
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading

_NEEDED, _OPTIONAL = ("scan", "photo"), ("camera", "camera_name", "more", "name")
_MAX_BYTES = 1 << 20
_MAX_ROWS = 200


@dataclass(frozen=True, slots=True)
class RigRow:
    """One pair of files."""

    name: str
    """For messages: that of the column `name`, else of the photograph; unlike those of the other rows."""
    scan: Path
    photo: Path
    camera: Path | None = None
    """The camera of this photograph; None: as for all."""
    more: tuple[Path, ...] = ()
    """Further scans of the same standpoint, to be accumulated."""
    camera_name: str = ""
    """Of the camera of the rig that took the photograph, where it has several."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file of the row."""
        return (self.scan, self.photo, *((self.camera,) if self.camera else ()), *self.more)


def read_rig_table(path: PathLike) -> list[RigRow]:
    """Read the table of a rig.

    Args:
        path: a CSV whose header names the columns `scan` and `photo` and perhaps `camera` (a camera file of the row),
            `camera_name` (which camera of the rig took it), `more` (further scans of the same standpoint, separated by
            `|`) and `name`. Paths start at its folder.

    Raises:
        FormatError: if a column is missing or unknown, a row is incomplete, repeated or names a file that is not there.
    """
    with reading(path) as file:
        header, rows = read_csv_table(file, most_bytes=_MAX_BYTES, needs="a CSV with the columns scan and photo")
        missing = [name for name in _NEEDED if name not in header]
        unknown = [name for name in header if name not in (*_NEEDED, *_OPTIONAL)]
        if missing or unknown or len(set(header)) < len(header):
            found = "does not name its columns" if missing else f"is {one_line(', '.join(header), 80)!r}"
            raise FormatError(
                f"its header {found}; it must name scan and photo, once each, and may name {', '.join(_OPTIONAL)}"
            )
        if not 1 <= len(rows) <= _MAX_ROWS:
            raise FormatError(f"it has {len(rows)} pairs; the table of a rig has 2 to {_MAX_ROWS}")
        names: dict[str, int] = {}
        found_rows: list[RigRow] = []
        for number, row in enumerate(rows, 1):
            one = _row(dict(zip(header, row, strict=False)), number, file.parent, len(row) > len(header))
            names[one.name] = names.get(one.name, 0) + 1
            if names[one.name] > 1:
                one = replace(one, name=f"{one.name} ({number})")
            same = next(
                (other.name for other in found_rows if (other.scan, other.photo) == (one.scan, one.photo)), None
            )
            if same is not None:
                raise FormatError(f"its pair {number} repeats {same}; a pair counts once: leave it out")
            found_rows.append(one)
        unnamed = [one.name for one in found_rows if not one.camera_name]
        if unnamed and len(unnamed) < len(found_rows):
            raise FormatError(
                f"it names the camera of some pairs and not of {one_line(unnamed[0], 60)}; fill in camera_name in each "
                "row, or leave the column out if the rig has one camera"
            )
        return found_rows


def _row(cells: dict[str, str], number: int, folder: Path, too_long: bool) -> RigRow:
    empty = [name for name in _NEEDED if not cells.get(name)]
    if empty or too_long:
        what = "more cells than the header" if too_long else f"no {empty[0]}"
        raise FormatError(f"its pair {number} has {what}; every row needs a scan and a photo")
    more = [name.strip() for name in cells.get("more", "").split("|") if name.strip()]
    names = [cells["scan"], cells["photo"], *([cells["camera"]] if cells.get("camera") else []), *more]
    for name in names:
        if not (folder / name).is_file():
            raise FormatError(
                f"its pair {number} names {one_line(name, 120)!r}, and there is no such file; paths are relative to "
                "the table's folder"
            )
    camera = folder / cells["camera"] if cells.get("camera") else None
    name = one_line(cells.get("name") or Path(cells["photo"]).stem, 60)
    return RigRow(
        name, folder / cells["scan"], folder / cells["photo"], camera, tuple(folder / one for one in more),
        one_line(cells.get("camera_name", ""), 60),
    )  # fmt: skip
