"""Camera files: the table of their formats, the choice among the cameras of one file, and ladarreg's own JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ladarreg_core.camera import Camera, CameraModel, camera_from_model_fields, require_pinhole
from ladarreg_core.camera.equirectangular import FULL_WINDOW
from ladarreg_core.errors import FormatError, OptionError, UnderspecifiedError
from ladarreg_core.formats.cameras.agisoft import read_agisoft, sniff_agisoft
from ladarreg_core.formats.cameras.calibration import cameras_of_calibration, read_calibration, sniff_calibration
from ladarreg_core.formats.cameras.camera_in_file import FileCamera, numbers_of, picture_size
from ladarreg_core.formats.cameras.colmap import (
    read_colmap_binary,
    read_colmap_text,
    sniff_colmap_binary,
    sniff_colmap_text,
)
from ladarreg_core.formats.cameras.fields import LARGEST_BYTES, notes_on_unused
from ladarreg_core.formats.cameras.kalibr import read_kalibr, sniff_kalibr
from ladarreg_core.formats.cameras.nerfstudio import is_nerfstudio, read_nerfstudio
from ladarreg_core.formats.parsing.json_file import (
    begins_with_brace,
    parsed_once,
    read_json_object,
    whole_number,
    write_json,
)
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading
from ladarreg_core.formats.photos.image_file import image_size
from ladarreg_core.frames import Rigid

_HEAD_BYTES = 4096
_MAX_LISTED = 12


@dataclass(frozen=True, slots=True)
class CameraFormat:
    """One format of camera files."""

    name: str
    """Name for users."""
    extensions: tuple[str, ...]
    """Usual file name extensions, lower case, with their dot."""
    sniff: Callable[[bytes, Path], bool]
    """Returns whether a file has this format, from its first bytes or, where they are not enough, from the file."""
    read: Callable[[Path], tuple[FileCamera, ...]]
    """Reads all cameras of a file."""
    is_json: bool = False
    """Whether it is JSON, which the table of all files recognises by its fields."""
    has_poses: bool = False
    """Whether it may state where the photographs were taken."""


def _read_json(path: Path) -> tuple[FileCamera, ...]:
    if (size := path.stat().st_size) > LARGEST_BYTES:
        raise FormatError(f"it has {size:,} bytes; a camera file has at most {LARGEST_BYTES:,}: give the right file")
    return _cameras_of_fields(read_json_object(path, "a camera file"))


def _sniff_nerfstudio(head: bytes, file: Path) -> bool:
    if not begins_with_brace(file):
        return False
    try:
        return is_nerfstudio(read_json_object(file, "transforms.json"))
    except FormatError:  # damaged: decide by the names in its first bytes, so that its reader says why
        return b'"fl_x"' in head or b'"transform_matrix"' in head


CAMERA_FORMATS: tuple[CameraFormat, ...] = (
    CameraFormat(
        "nerfstudio transforms.json", (".json",), _sniff_nerfstudio, read_nerfstudio, is_json=True, has_poses=True
    ),
    CameraFormat("camera JSON", (".json",), lambda _, file: begins_with_brace(file), _read_json, is_json=True),
    CameraFormat("Agisoft XML", (".xml",), sniff_agisoft, read_agisoft),
    CameraFormat("Kalibr camchain", (".yaml", ".yml"), sniff_kalibr, read_kalibr),
    CameraFormat("COLMAP cameras.txt", (".txt",), sniff_colmap_text, read_colmap_text, has_poses=True),
    CameraFormat("camera YAML or XML", (".yaml", ".yml", ".xml"), sniff_calibration, read_calibration),
    CameraFormat("COLMAP cameras.bin", (".bin",), sniff_colmap_binary, read_colmap_binary, has_poses=True),
)
"""All formats of camera files, in the order in which they are tried."""


def camera_format(path: PathLike) -> str:
    """Return the name of the format that a camera file is read as."""
    with reading(path) as file, parsed_once():
        found = _format_of(file)
        return found.name if found else "YAML"


def _format_of(file: Path) -> CameraFormat | None:
    with open(file, "rb") as stream:
        head = stream.read(_HEAD_BYTES)
    return next((known for known in CAMERA_FORMATS if known.sniff(head, file)), None)


def read_cameras(path: PathLike) -> tuple[FileCamera, ...]:
    """Read all cameras of a file, its format recognised by content.

    Raises:
        FormatError: if it is not a camera file.
        CameraError: if the parameters of a camera are invalid, or its model is unknown.
    """
    with reading(path) as file, parsed_once():
        found = _format_of(file)
        return read_calibration(file) if found is None else found.read(file)


def read_camera(
    path: PathLike, *, name: str | None = None, picture: str = "", picture_file: PathLike | None = None
) -> CameraModel:
    """Read a camera, its format recognised by content; arguments and errors as `read_noted_camera`."""
    return read_noted_camera(path, name=name, picture=picture, picture_file=picture_file)[0]


def read_noted_camera(
    path: PathLike, *, name: str | None = None, picture: str = "", picture_file: PathLike | None = None
) -> tuple[CameraModel, tuple[str, ...]]:
    """Read the camera of a photograph, with notes, from a file that may have several cameras.

    The camera is the one called `name`, or else the only one, the one that took a picture of the photograph's name, or
    the only one whose pictures have the photograph's size.

    Args:
        path: the file.
        name: name of the camera in the file; None: chosen by the photograph.
        picture: file name of the photograph; empty: unknown.
        picture_file: the photograph, whose header gives its size; None: unknown.

    Raises:
        FormatError: if it is not a camera file.
        CameraError: if the parameters of a camera are invalid, or its model is unknown.
        UnderspecifiedError: if it is not clear which of its cameras is meant.
        OptionError: if there is no camera of that name.
    """
    sizes = _sizes_of(picture_file)
    token = picture_size.set(sizes[0] if sizes else None)
    try:
        cameras = read_cameras(path)
    finally:
        picture_size.reset(token)
    with reading(path):
        if name is not None:
            chosen, why = _named(cameras, name), "as chosen"
        elif len(cameras) == 1:
            chosen, why = cameras[0], ""
        else:
            chosen, why = _of_picture(cameras, picture, sizes)
    if picture and any(_is_same_picture(other, picture) for other in chosen.poses or ()):
        posed: tuple[str, ...] = (
            "the camera file states this photograph's pose; if its world is the scan's, give it as the initial pose",
        )
    else:
        posed = ()
    said = (f"the file has {len(cameras)} cameras; this is {one_line(chosen.name, 40)}, {why}",) if why else ()
    return chosen.camera, said + chosen.notes + posed


def read_stated_pose(path: PathLike, picture: str) -> Rigid | None:
    """Return `camera_from_world` of a photograph, in the world of the reconstruction that a file describes.

    Args:
        path: the file.
        picture: file name of the photograph.

    Returns:
        None if the format of the file states no poses.

    Raises:
        FormatError: if the file states poses, but not that of the photograph.
    """
    with reading(path) as file, parsed_once():
        found = _format_of(file)
        if found is None or not found.has_poses:
            return None
        for each in found.read(file):
            for name, pose in (each.poses or {}).items():
                if _is_same_picture(name, picture):
                    return pose
        raise FormatError(
            f"it states no pose of the photograph {one_line(_base(picture), 60)!r}; check the file's name"
        )


def _of_picture(
    cameras: tuple[FileCamera, ...], picture: str, sizes: Sequence[tuple[int, int]]
) -> tuple[FileCamera, str]:
    """Return the camera that a photograph's name or size decides on, and a phrase that says how."""
    ways: tuple[tuple[Callable[[FileCamera], bool], str], ...] = (
        (lambda each: _took(each, picture), "which took a picture of that name"),
        (lambda each: _is_in_name(each.name, picture), "named in the photograph's name"),
        (lambda each: each.camera.size in sizes, "chosen by the photograph's size"),
    )
    for fits, why in ways:
        found = [each for each in cameras if fits(each)]
        if found and all(each.camera == found[0].camera for each in found):
            return found[0], why
        cameras = tuple(found) or cameras
    raise UnderspecifiedError(
        f"it has {len(cameras)} cameras that could be meant, {_listed(cameras)}; choose one by its name (`camera_name`)"
    )


def _sizes_of(picture_file: PathLike | None) -> tuple[tuple[int, int], ...]:
    """Return the sizes that a photograph may have, raw and turned; none where it is unknown."""
    if picture_file is None:
        return ()
    try:
        width, height, _ = image_size(Path(picture_file))
    except FormatError:  # its reader says what is wrong with it
        return ()
    return (width, height), (height, width)


def _named(cameras: Sequence[FileCamera], name: str) -> FileCamera:
    wanted = name.strip().casefold()
    by_name = [each for each in cameras if each.name.casefold() == wanted]
    by_picture = [each for each in cameras if wanted in (_base(other).casefold() for other in each.pictures)]
    for found in (by_name, by_picture):
        if found and all(each.camera == found[0].camera for each in found):
            return found[0]
    if len(cameras) == 1 and not cameras[0].name:
        raise OptionError(f"it has one camera without a name, but {one_line(name, 40)!r} is asked for; omit the name")
    raise OptionError(f"it has no camera {one_line(name, 40)!r}; its cameras are {_listed(cameras)}: give one of these")


def _base(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).name


def _took(camera: FileCamera, picture: str) -> bool:
    """Return whether a camera took the picture of a name; programs leave out folders and extensions."""
    return any(_is_same_picture(other, picture) for other in camera.pictures)


def _is_same_picture(stated: str, picture: str) -> bool:
    name = _base(picture).casefold()
    return bool(name) and _base(stated).casefold() in (name, PurePosixPath(name).stem)


def _is_in_name(name: str, picture: str) -> bool:
    """Return whether a camera's name is one of the words of a photograph's name: `cam1` in `cam1_00023.png`."""
    words = "".join(c if c.isalnum() else " " for c in PurePosixPath(_base(picture)).stem.casefold()).split()
    return bool(name) and not name.isdigit() and name.casefold() in words


def _listed(cameras: Sequence[FileCamera]) -> str:
    shown = [
        f"{one_line(each.name or '(no name)', 30)} ({each.camera.width} x {each.camera.height})" for each in cameras
    ]
    more = [f"{len(shown) - _MAX_LISTED} more"] if len(shown) > _MAX_LISTED else []
    return ", ".join([*shown[:_MAX_LISTED], *more])


def write_camera(path: PathLike, camera: CameraModel) -> None:
    """Write a camera as JSON.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_json(path, camera_fields(camera))


def camera_fields(camera: CameraModel) -> dict[str, Any]:
    """Return the fields of a camera's JSON."""
    return camera.as_fields()


def camera_from_fields(fields: Mapping[str, Any]) -> CameraModel:
    """Return the camera described by the fields of a file.

    Args:
        fields: those of ladarreg (`fx`, ...) or of a calibration tool (`camera_matrix`, `K`, ..., in any case).

    Raises:
        FormatError: if fields are missing.
        CameraError: if their values are invalid, or its model is unknown.
    """
    return _cameras_of_fields(fields)[0].camera


def pinhole_from_fields(fields: Mapping[str, Any]) -> Camera:
    """Return the camera as `camera_from_fields`, which must be a pinhole.

    Raises:
        CameraError: as there, or if it is of another model.
    """
    return require_pinhole(camera_from_fields(fields), "A depth image")


def _cameras_of_fields(fields: Mapping[str, Any]) -> tuple[FileCamera, ...]:
    if fields.get("model") == "equirectangular":
        return (_panorama_of(fields),)
    nested = fields.get("camera")
    if isinstance(nested, Mapping) and nested.get("model") == "equirectangular":
        return (_panorama_of(nested),)
    return cameras_of_calibration(fields)


def _panorama_of(fields: Mapping[str, Any]) -> FileCamera:
    values: dict[str, Any] = {name: whole_number(fields, name) for name in ("width", "height")}
    window = fields.get("window")
    values["window"] = None if window is None else tuple(numbers_of(window, "the window"))
    unused = {name: value for name, value in fields.items() if name not in (*values, "model")}
    return FileCamera(
        camera=camera_from_model_fields({"model": "equirectangular", **values}), notes=notes_on_unused(unused)
    )


def describe_camera(camera: CameraModel) -> dict[str, Any]:
    """Return a camera's parameters, formatted for display."""
    facts: dict[str, Any] = {} if camera.as_pinhole is not None else {"model": camera.model}
    facts["size"] = f"{camera.width} x {camera.height} px"
    panorama = camera.as_panorama
    if panorama is not None:
        window = panorama.window or FULL_WINDOW
        return {**facts, "window_deg": " ".join(f"{angle:g}" for angle in window)}
    fields = camera.as_fields()
    return {
        **facts,
        "focal_px": f"{fields['fx']:.2f}, {fields['fy']:.2f}",
        "principal_point_px": f"{fields['cx']:.2f}, {fields['cy']:.2f}",
        "distortion": " ".join(f"{k:.6g}" for k in fields["distortion"]) or "none",
    }
