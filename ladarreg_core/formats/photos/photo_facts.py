"""What the header of a photograph says of the camera that took it, without its pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading
from ladarreg_core.formats.photos.exif import exif_facts, orientation_of
from ladarreg_core.formats.photos.image_file import image_header

_LONGEST_NAME = 60


@dataclass(frozen=True, slots=True)
class PhotoFacts:
    """Size and camera of a photograph, by its header."""

    width: int
    """Of the pixels as stored, before EXIF's orientation is applied."""
    height: int
    """Likewise."""
    orientation: int = 1
    """EXIF's orientation, 1 to 8."""
    body: str = ""
    """Make and model; empty: not stated."""
    lens: str = ""
    """Model of the lens; empty: not stated."""
    focal_mm: float | None = None
    """Focal length, mm; None: not stated."""
    film_mm: float | None = None
    """35 mm equivalent of the focal length, mm; None: not stated."""

    @property
    def words(self) -> str:
        """The camera in words, for users."""
        focal = f"{self.focal_mm:g} mm" if self.focal_mm else f"{self.film_mm:g} mm (35 mm)" if self.film_mm else ""
        named = [one for one in (self.body, self.lens, focal) if one]
        return f"{', '.join(named) or 'camera not stated'}, {self.width} x {self.height} px"


def photo_facts(path: PathLike) -> PhotoFacts:
    """Return what the header of a photograph says.

    Raises:
        FormatError: if it is not an image.
    """
    return PhotoFacts(**header_fields(path))


def header_fields(path: PathLike) -> dict[str, Any]:
    """Return the fields of `PhotoFacts` as plain values, which a confined reader can answer with."""
    with reading(path) as file:
        (width, height), tags = image_header(file)
    facts = exif_facts(tags)
    return {
        "width": width,
        "height": height,
        "orientation": orientation_of(tags),
        "body": " ".join(filter(None, (_name(facts, "make"), _name(facts, "model")))),
        "lens": _name(facts, "lens"),
        "focal_mm": facts.get("focal_mm"),
        "film_mm": facts.get("focal_35mm_equivalent"),
    }


def _name(facts: Mapping[str, Any], key: str) -> str:
    return one_line(facts[key], _LONGEST_NAME) if key in facts else ""
