"""What an operator says about a file that the file does not: where the scanner stood, its unit, and so on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

import msgspec

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Source

_NAMES = ("scan_index", "origin", "intensity", "columns", "topic", "seconds")
_OF_OTHERS = ("temperature_unit", "camera_name")


def reading_of(value: object) -> Mapping[str, Any]:
    """Return the checked options in the field `reading` of a message; none where it is missing.

    They are those of `read_scan`, `temperature_unit` and `camera_name`.

    Raises:
        OptionError: if an option is unknown, or its value is not of its type or range.
    """
    from ladarreg_core.formats.scans.scan_request import ScanRequest
    from ladarreg_core.thermal import TemperatureUnit

    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise OptionError("how the scan is to be read is not a list of options; reload the page")
    given = dict(value)
    others = {name: given.pop(name) for name in _OF_OTHERS if given.get(name) is not None}
    if others.get("temperature_unit", "K") not in get_args(TemperatureUnit):
        raise OptionError("the unit of temperature must be K, C or none; choose one of them")
    if not isinstance(others.get("camera_name", ""), str):
        raise OptionError("the name of the camera is not a text; choose one of the file's cameras")
    value = given
    unknown = sorted(set(map(str, value)) - set(_NAMES))
    if unknown:
        raise OptionError(f"a scan cannot be read with {unknown[0][:40]!r}; it takes {', '.join(_NAMES)}")
    index = value.get("scan_index", 0)
    if isinstance(index, bool) or not isinstance(index, int) or index < 0:
        raise OptionError("the number of the scan is not a whole number from 0; choose one of the file's scans")
    lists = {name: tuple(value[name]) for name in ("origin", "columns") if isinstance(value.get(name), list)}
    chosen = {"scan_index": index} if "scan_index" in value else {}  # the first scan, too, can be chosen
    return {**ScanRequest(**{**value, **lists}).given(), **chosen, **others}


def with_reading(source: Source, reading: Mapping[str, Any]) -> Source:
    """Return the reference to a scan's file with the options that it is to be read with."""
    given = {name: value for name, value in reading.items() if name not in _OF_OTHERS}
    fields = {("index" if name == "scan_index" else name): value for name, value in given.items()}
    return msgspec.structs.replace(source, **fields)
