"""Radiometric JPEGs: pictures in false colours with the temperatures hidden in them.

Their formats are the makers' own. The temperatures are read where the user has installed a reader for them; the false
colours are never taken for a photograph unless that is asked for.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError

_MAX_SEGMENTS = 2000
_MIN_DJI_BYTES = 100_000  # of raw temperatures: 640 x 512 pixels take 655,360
_FLIR, _DJI = "FLIR", "DJI"


def radiometric_maker(path: Path) -> str | None:
    """Return the maker of a radiometric JPEG, `FLIR` or `DJI`; None if a file is another one."""
    dji_bytes, is_dji = 0, False
    with open(path, "rb") as stream:
        if stream.read(2) != b"\xff\xd8":
            return None
        for _ in range(_MAX_SEGMENTS):
            head = stream.read(4)
            if len(head) < 4 or head[0] != 0xFF or head[1] in (0xD9, 0xDA):
                break
            length = int.from_bytes(head[2:4], "big") - 2
            start = stream.read(min(max(length, 0), 4096))
            if head[1] == 0xE1 and start.startswith(b"FLIR\0"):
                return _FLIR
            is_dji = is_dji or (head[1] == 0xE1 and b"DJI" in start)
            dji_bytes += length if head[1] == 0xE3 else 0
            stream.seek(max(length - len(start), 0), 1)
    return _DJI if is_dji and dji_bytes >= _MIN_DJI_BYTES else None


def radiometric_kelvin(path: Path, maker: str) -> NDArray[np.float32]:
    """Return the temperatures (H, W), K, of a radiometric JPEG, by a reader that the user has installed.

    Raises:
        FormatError: if there is none, or it fails.
    """
    if maker != _FLIR:
        _refuse(maker, "export the temperatures as TIFF, e.g. by the maker's Thermal SDK (measure, float32)")
    try:
        flyr = importlib.import_module("flyr")
    except ImportError:
        _refuse(maker, "install the package flyr (pip install flyr), or export the temperatures as TIFF")
    return np.asarray(flyr.unpack(str(path)).kelvin, dtype=np.float32)


def _refuse(maker: str, what_to_do: str) -> NoReturn:
    raise FormatError(
        f"it is a radiometric JPEG of {maker}, whose visible picture is in false colours; {what_to_do}; or read the "
        "picture itself by `temperature_unit='none'`"
    )
