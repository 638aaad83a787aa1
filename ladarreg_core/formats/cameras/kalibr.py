"""Kalibr's camchain: the intrinsics of one or several cameras, and the transforms between neighbours.

Pixels: (0, 0) is the centre of the top-left pixel, as in ladarreg. `T_cn_cnm1` maps points of the previous camera into
this one's frame.

Source: Kalibr's wiki, "YAML formats" and "Supported models".
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ladarreg_core.errors import CameraError, FormatError
from ladarreg_core.formats.cameras.camera_in_file import (
    FileCamera,
    lens_camera,
    lens_of,
    naming,
    numbers_of,
    refuse_model,
    rigid_of,
)
from ladarreg_core.formats.cameras.fields import notes_on_unused, read_fields
from ladarreg_core.formats.parsing.json_file import whole_number
from ladarreg_core.frames import Rigid

_FIRST = re.compile(rb"(^|\n)\s*cam0\s*:")
_USED = ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "T_cn_cnm1")
_NAME = re.compile(r"cam(\d{1,3})")


def sniff_kalibr(head: bytes, file: Path) -> bool:
    """Return whether a file begins like a camchain."""
    return _FIRST.search(head) is not None and any(w in head for w in (b"intrinsics", b"camera_model", b"T_cn_cnm1"))


def read_kalibr(path: Path) -> tuple[FileCamera, ...]:
    """Return the cameras of a camchain, named `cam0`, `cam1`, ..., with their poses relative to the first.

    Raises:
        FormatError: if fields are missing.
        CameraError: if a model is not `pinhole` with `radtan`, `equidistant` or `none`.
    """
    fields = read_fields(path)
    names = sorted((name for name in fields if _NAME.fullmatch(name)), key=lambda name: int(name[3:]))
    if not names:
        raise FormatError("it has no camera cam0; a camchain of Kalibr has cam0, cam1, ...: give the right file")
    found: list[FileCamera] = []
    place: Rigid | None = Rigid.identity()
    for name in names:
        with naming(name):
            entry = fields[name]
            if not isinstance(entry, Mapping):
                raise FormatError("it is not a mapping of names to values; export the camchain again")
            step = entry.get("T_cn_cnm1")
            if found:
                place = None if step is None or place is None else rigid_of(step, "T_cn_cnm1") @ place
            found.append(_camera_of(name, entry, place if len(names) > 1 else None))
    return tuple(found)


def _camera_of(name: str, entry: Mapping[str, Any], camera_from_first: Rigid | None) -> FileCamera:
    model = str(entry.get("camera_model") or "pinhole")
    if model.casefold() != "pinhole":
        refuse_model(model, "calibrate with pinhole-radtan or pinhole-equi")
    intrinsics = numbers_of(entry.get("intrinsics"), "intrinsics")
    if len(intrinsics) != 4:
        raise FormatError(f"the intrinsics have {len(intrinsics)} numbers; pinhole has 4: fu, fv, pu, pv")
    lens = lens_of(entry.get("distortion_model"))
    terms = numbers_of(entry.get("distortion_coeffs") or [], "distortion_coeffs")
    if len(terms) not in (0, 4):
        raise CameraError(f"it has {len(terms)} distortion_coeffs; radtan and equidistant have 4")
    size = numbers_of(entry.get("resolution"), "resolution")
    if len(size) != 2:
        raise FormatError("the resolution is not width and height; add resolution: [width, height]")
    sides = dict(zip(("width", "height"), size, strict=True))
    return FileCamera(
        camera=lens_camera(lens, whole_number(sides, "width"), whole_number(sides, "height"), intrinsics, terms),
        name=name,
        notes=notes_on_unused({key: value for key, value in entry.items() if key not in _USED}),
        camera_from_first=camera_from_first,
    )
