"""The core's texts name arguments in backquotes; here they become options of the command line or fields of the page."""

from __future__ import annotations

import re

_NAMED = re.compile(r"`(\w+)(?:=([^`]*))?`")
_FLAGS = {
    "calibrate_mount": "--calibrate-mount",
    "camera": "--camera FILE",
    "camera_model": "--camera-model",
    "camera_name": "--camera-name",
    "cloud": "--cloud TOPIC",
    "columns": "--columns",
    "deskewed": "--deskewed",
    "fixed": "--fixed",
    "focal_mm": "--focal-mm",
    "focal_px": "--focal-px",
    "force": "--force",
    "images": "--image TOPIC",
    "inputs": "--inputs",
    "intensity": "--intensity",
    "match_tolerance_m": "--match-tolerance-m",
    "origin": "--origin X,Y,Z",
    "poses": "--poses",
    "processes": "--processes",
    "resume": "--resume",
    "scan_index": "--scan",
    "seconds": "--seconds",
    "sensor_mm": "--sensor-mm",
    "temperature_unit": "--temperature-unit",
    "topic": "--topic",
    "trust_edited": "--trust-edited",
}
_FIELDS = {
    "calibrate_mount": "ladarreg panorama --calibrate-mount",
    "camera": "a camera file",
    "camera_model": "'It is a panorama'",
    "camera_name": "'Camera'",
    "cloud": "ladarreg register --rig FILE --cloud",
    "columns": "'Columns'",
    "deskewed": "ladarreg register --rig FILE --deskewed",
    "fixed": "the fixed scan",
    "focal_mm": "the focal length in mm",
    "focal_px": "the focal length in pixels",
    "force": "'replace earlier results'",
    "images": "ladarreg register --rig FILE --image",
    "intensity": "'Use the brightness of the colours as the intensity'",
    "match_tolerance_m": "the setting 'Lengths of targets'",
    "origin": "'Scanner stood at'",
    "poses": "'Poses in the files':",
    "processes": "ladarreg register --processes",
    "resume": "'Resume'",
    "scan_index": "'Scan of the file'",
    "seconds": "'Accumulate over'",
    "sensor_mm": "the sensor width",
    "temperature_unit": "'Unit of its temperatures'",
    "topic": "'Topic'",
    "trust_edited": "ladarreg export --trust-edited",
}
_SHOWN_ON_PAGE = {"columns", "poses", "scan_index", "temperature_unit"}


def as_flags(text: str) -> str:
    """Return a text with the arguments that it names as options of the command line."""
    return _NAMED.sub(_flag, text)


def as_fields(text: str) -> str:
    """Return a text with the arguments that it names as fields and buttons of the page."""
    return _NAMED.sub(_field, text)


def _flag(found: re.Match[str]) -> str:
    name, value = found.groups()
    flag = _FLAGS.get(name)
    if flag is None:
        return found[0]
    return flag if value in (None, "True") else f"{flag.partition(' ')[0]} {value.strip(chr(39))}"


def _field(found: re.Match[str]) -> str:
    name, value = found.groups()
    field = _FIELDS.get(name)
    if field is None:
        return found[0]
    return f"{field} {value.strip(chr(39))}" if value and name in _SHOWN_ON_PAGE else field
