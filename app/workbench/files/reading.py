"""What an operator says about a file that the file does not: where the scanner stood, its unit, and so on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from ladarreg_core.errors import OptionError
from ladarreg_core.project.source import Source

from ...decoding import decoded


class _OfOthers(msgspec.Struct):
    """Options of photographs and cameras, which are opened by the same form."""

    temperature_unit: Annotated[Literal["K", "C", "none"], Meta(description="K, C or none")] | None = None
    camera_name: Annotated[str, Meta(description="one of the file's cameras")] | None = None


def reading_of(value: object) -> Mapping[str, Any]:
    """Return the checked options in the field `reading` of a message; none where it is missing.

    They are those of `read_scan`, `temperature_unit` and `camera_name`.

    Raises:
        OptionError: if an option is unknown, or its value is not of its type or range.
    """
    from ladarreg_core.formats.scans.scan_request import SCAN_OPTIONS, ScanOptions

    if value is not None and not isinstance(value, Mapping):
        raise OptionError("how the scan is to be read is not a list of options; reload the page")
    given = dict(value or {})
    others = {name: given.pop(name) for name in _OfOthers.__struct_fields__ if name in given}
    unknown = sorted(given.keys() - {*SCAN_OPTIONS})
    if unknown:
        raise OptionError(f"a scan cannot be read with {unknown[0][:40]!r}; it takes {', '.join(SCAN_OPTIONS)}")
    options, of_others = decoded(ScanOptions, given, arguments=True), decoded(_OfOthers, others, arguments=True)
    chosen = {name: options.scan_index for name in ("scan_index",) if name in given}  # the first one, too
    stated = {name: one for name in others if (one := getattr(of_others, name)) is not None}
    return {**options.given(), **chosen, **stated}


def with_reading(source: Source, reading: Mapping[str, Any]) -> Source:
    """Return the reference to a scan's file with the options that it is to be read with."""
    given = {name: value for name, value in reading.items() if name not in _OfOthers.__struct_fields__}
    fields = {("index" if name == "scan_index" else name): value for name, value in given.items()}
    return msgspec.structs.replace(source, **fields)
