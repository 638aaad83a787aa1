"""Arguments of the core as users know them: options of the command line, and fields of the page.

The core's texts name arguments in backquotes; here they become the one or the other.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .slices.choices import InputKind
    from .slices.project import ReadingField


@dataclass(frozen=True, slots=True, kw_only=True)
class Argument:
    """An argument of the core."""

    flag: str
    """Its option, with what follows it."""
    label: str = ""
    """Its field on the page; empty: it has none."""
    words: str = ""
    """How texts on the page name it; empty: by its label."""
    value_shown: bool = False
    """Whether a value that a text gives it is shown on the page."""
    hint: str = ""
    """What is entered in the form for reading a file."""
    example: str = ""
    """An example of it."""
    kind: InputKind | None = None
    """How it is entered there; None: it is not."""

    @property
    def named(self) -> str:
        """Its name in texts on the page."""
        return self.words or f"'{self.label}'"


ARGUMENTS: dict[str, Argument] = {
    "scan_index": Argument(
        flag="--scan", label="Scan of the file", value_shown=True,
        hint="its number, counted from 0", example="0", kind="whole",
    ),
    "origin": Argument(
        flag="--origin X,Y,Z", label="Scanner stood at",
        hint="x, y, z in the file's coordinates, m", example="12.5, -3, 1.8", kind="coordinates",
    ),
    "columns": Argument(
        flag="--columns", label="Columns", value_shown=True,
        hint="names in order; - skips one", example="x, y, z, intensity", kind="names",
    ),
    "topic": Argument(
        flag="--topic", label="Topic", hint="of the clouds in the recording", example="/points", kind="text"
    ),
    "seconds": Argument(
        flag="--seconds", label="Accumulate over", hint="seconds", example="2", kind="duration"
    ),
    "intensity": Argument(
        flag="--intensity", label="Use the brightness of the colours as the intensity", example="luma", kind="switch"
    ),
    "temperature_unit": Argument(
        flag="--temperature-unit", label="Unit of its temperatures", value_shown=True,
        hint="K or C; none for an ordinary picture", example="C", kind="temperature_unit",
    ),
    "camera_name": Argument(
        flag="--camera-name", label="Camera", hint="its name in the file", example="cam0", kind="text"
    ),
    "calibrate_mount": Argument(flag="--calibrate-mount", words="ladarreg panorama --calibrate-mount"),
    "camera": Argument(flag="--camera FILE", words="a camera file"),
    "camera_model": Argument(flag="--camera-model", label="It is a panorama"),
    "cloud": Argument(flag="--cloud TOPIC", words="ladarreg register --rig FILE --cloud"),
    "deskewed": Argument(flag="--deskewed", words="ladarreg register --rig FILE --deskewed"),
    "fixed": Argument(flag="--fixed", words="the fixed scan"),
    "focal_mm": Argument(flag="--focal-mm", words="the focal length in mm"),
    "focal_px": Argument(flag="--focal-px", words="the focal length in pixels"),
    "force": Argument(flag="--force", label="replace an earlier export"),
    "images": Argument(flag="--image TOPIC", words="ladarreg register --rig FILE --image"),
    "inputs": Argument(flag="--inputs"),
    "insecure_cluster": Argument(flag="--insecure-cluster", words="ladarreg batch --insecure-cluster"),
    "kind": Argument(flag="--kind", words="ladarreg measure --kind"),
    "memory_gb": Argument(flag="--memory-gb", words="ladarreg batch --memory-gb"),
    "match_tolerance_m": Argument(flag="--match-tolerance-m", words="the setting 'Lengths of targets'"),
    **{
        name: Argument(flag=f"--{name.replace('_', '-')}", words=f"ladarreg register --{name.replace('_', '-')}")
        for name in ("centre_sigma_percent", "culling", "first_pose", "focal_sigma_percent", "intrinsics", "k1_sigma",
                     "matches", "method", "proposal", "reject_depth_m", "residual", "t1", "t2_px")
    },
    "poses": Argument(flag="--poses", words="'Poses in the files':", value_shown=True),
    "processes": Argument(flag="--processes", words="ladarreg register --processes"),
    "resume": Argument(flag="--resume", label="Resume"),
    "sensor_mm": Argument(flag="--sensor-mm", words="the sensor width"),
    "trust_edited": Argument(flag="--trust-edited", words="ladarreg export --trust-edited"),
}  # fmt: skip
# In the text, and not by `LadarregError.field` alone: reasons, notes and advice name arguments, too, often several.
_NAMED = re.compile(r"`(\w+)(?:=([^`]*))?`")


def reading_slice() -> dict[str, ReadingField]:
    """Return the slice `reading`: the fields of the form for what a file does not state itself."""
    return {
        name: {"label": one.label, "hint": one.hint, "example": one.example, "kind": one.kind}
        for name, one in ARGUMENTS.items()
        if one.kind is not None
    }


def as_flags(text: str) -> str:
    """Return a text with the arguments that it names as options of the command line."""
    return _NAMED.sub(_flag, text)


def as_fields(text: str) -> str:
    """Return a text with the arguments that it names as fields and buttons of the page."""
    return _NAMED.sub(_field, text)


def _flag(found: re.Match[str]) -> str:
    name, value = found.groups()
    argument = ARGUMENTS.get(name)
    if argument is None:
        return found[0]
    if value in (None, "True"):
        return argument.flag
    return f"{argument.flag.partition(' ')[0]} {value.strip(chr(39))}"


def _field(found: re.Match[str]) -> str:
    name, value = found.groups()
    argument = ARGUMENTS.get(name)
    if argument is None or not (argument.label or argument.words):
        return found[0]
    return f"{argument.named} {value.strip(chr(39))}" if value and argument.value_shown else argument.named
