"""A camera as a file states it, and the models that programs name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import CameraError, FormatError, LadarregError
from ladarreg_core.formats.parsing.json_file import number
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.frames import Rigid

Lens = Literal["pinhole", "fisheye"]
READ_MODELS = "pinhole (0, 4, 5, 8 or 12 OpenCV terms), fisheye (OpenCV's 4 terms) and equirectangular"
_TERM_COUNTS = (0, 4, 5, 8, 12)
picture_size: ContextVar[tuple[int, int] | None] = ContextVar("picture_size", default=None)
"""Width and height of the photograph whose camera is read, for files that state no size; None: unknown."""
_LENS_OF: Mapping[str, Lens] = {
    **dict.fromkeys(
        ("", "none", "pinhole", "perspective", "plumbbob", "rationalpolynomial", "radtan", "radialtangential", "opencv",
         "brown", "brownconrady", "standard", "thinprism", "pinholefull", "rectified"),
        "pinhole",
    ),
    **dict.fromkeys(("fisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt4", "kannalabrandt8",
                     "opencvfisheye"), "fisheye"),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class FileCamera:
    """One camera of a file."""

    camera: CameraModel
    """Its intrinsics."""
    name: str = ""
    """Its name in the file; empty: a file with one camera need not name it."""
    pictures: tuple[str, ...] = ()
    """File names of the photographs that it took, as the file states them."""
    poses: Mapping[str, Rigid] | None = None
    """`camera_from_world` of these photographs, by their name; the world is the file's own."""
    notes: tuple[str, ...] = ()
    """Remarks on the conversion for the operator."""
    camera_from_first: Rigid | None = None
    """Its pose relative to the first camera of a rig, where the file states it."""


def lens_of(model: object) -> Lens:
    """Return the lens that a program's name of a distortion model means.

    Raises:
        CameraError: if the model is unknown.
    """
    word = "".join(c for c in str(model or "").casefold() if c.isalnum())
    lens = _LENS_OF.get(word)
    if lens is None:
        refuse_model(model)
    return lens


def refuse_model(model: object, instead: str = "calibrate with one of these") -> NoReturn:
    """Refuse a camera model by its name."""
    raise CameraError(
        f"the camera model is {one_line(model, 40)!r}, which is not read; the models are {READ_MODELS}: {instead}"
    )


def lens_camera(lens: Lens, width: int, height: int, matrix: Sequence[float], terms: Sequence[float]) -> CameraModel:
    """Return the camera of a lens with OpenCV's distortion.

    Args:
        lens: `pinhole` or `fisheye`.
        width: pixels.
        height: pixels.
        matrix: fx, fy, cx, cy, where (0, 0) is the centre of the top-left pixel.
        terms: OpenCV's terms in its order; trailing zeros may be present or absent.

    Raises:
        CameraError: if they are invalid.
    """
    fx, fy, cx, cy = matrix
    kept = list(terms)
    if lens == "fisheye":
        return FisheyeCamera(width, height, fx, fy, cx, cy, tuple(kept))
    for longer, shorter in ((14, 12), (12, 8)):
        if len(kept) == longer and not any(kept[shorter:]):
            kept = kept[:shorter]
    if len(kept) not in _TERM_COUNTS and len(kept) < 14:  # some programs write six zeros
        needed = max((at for at, term in enumerate(kept, 1) if term), default=0)
        fitting = [count for count in _TERM_COUNTS if needed <= count <= len(kept)]
        kept = kept[: fitting[0]] if fitting else kept
    if len(kept) == 14:
        raise CameraError(
            "the distortion has 14 terms with a tilted sensor, which is not read; calibrate with at most 12 terms"
        )
    return Camera(width, height, fx, fy, cx, cy, tuple(kept))


def equirectangular_camera(width: int, height: int) -> CameraModel:
    """Return the camera of a full panorama."""
    return EquirectangularCamera(width, height)


def numbers_of(value: Any, what: str) -> list[float]:
    """Return the numbers in a list, a list of lists, or an OpenCV matrix with its `data`.

    Raises:
        FormatError: if it is something else.
    """
    if isinstance(value, Mapping):
        data = value.get("data")
        numbers = numbers_of(data if data is not None else [], what)
        rows, columns = value.get("rows"), value.get("cols")
        if isinstance(rows, int) and isinstance(columns, int) and rows * columns != len(numbers):
            raise FormatError(f"{what} has {len(numbers)} numbers; its rows and cols say {rows} x {columns}")
        return numbers
    if not isinstance(value, list):
        raise FormatError(f"{what} is {one_line(repr(value), 60)}; it must be a list of numbers")
    if value and all(isinstance(item, list) for item in value):
        value = [item for row in value for item in row]
    return [number({what: item}, what) for item in value]


def rigid_of(rows: Any, what: str) -> Rigid:
    """Return a 4 x 4 transform of a file.

    Raises:
        FormatError: if it is not a rigid transform.
    """
    numbers = numbers_of(rows, what)
    if len(numbers) == 12:
        numbers += [0.0, 0.0, 0.0, 1.0]
    if len(numbers) != 16:
        raise FormatError(f"{what} has {len(numbers)} numbers; it must have 16 (4 x 4)")
    try:
        return Rigid.from_matrix([numbers[k : k + 4] for k in (0, 4, 8, 12)])
    except LadarregError as error:
        raise FormatError(f"{what} is not a rigid transform: {error}") from error


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Put the name of a camera, if it has one, in front of the errors that it causes."""
    try:
        yield
    except LadarregError as error:
        if not what:
            raise
        raise type(error)(f"{one_line(what, 40)}: {error}") from error
