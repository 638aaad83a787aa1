"""What an operator says about a scan's file that the file does not: where the scanner stood, its columns, and so on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Source

_NAMES = ("scan_index", "origin", "intensity", "columns", "topic", "seconds")


def reading_of(value: object) -> Mapping[str, Any]:
    """Return the checked options of `read_scan` in the field `reading` of a message; none where it is missing.

    Raises:
        OptionError: if an option is unknown, or its value is not of its type or range.
    """
    from ladarreg_core.formats.scan_request import ScanRequest

    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise OptionError("how the scan is to be read is not a list of options; reload the page")
    unknown = sorted(set(map(str, value)) - set(_NAMES))
    if unknown:
        raise OptionError(f"a scan cannot be read with {unknown[0][:40]!r}; it takes {', '.join(_NAMES)}")
    index = value.get("scan_index", 0)
    if isinstance(index, bool) or not isinstance(index, int) or index < 0:
        raise OptionError("the number of the scan is not a whole number from 0; choose one of the file's scans")
    lists = {name: tuple(value[name]) for name in ("origin", "columns") if isinstance(value.get(name), list)}
    return ScanRequest(**{**value, **lists}).given()


def with_reading(source: Source, reading: Mapping[str, Any]) -> Source:
    """Return the reference to a scan's file with the options that it is to be read with."""
    fields = {("index" if name == "scan_index" else name): value for name, value in reading.items()}
    return msgspec.structs.replace(source, **fields)
