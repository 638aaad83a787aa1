"""Extraction of the images embedded in E57 files, with their cameras and poses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera
from ladarreg_core.errors import CameraError, ExportError, FormatError, OptionError
from ladarreg_core.formats.cameras.camera_file import write_camera
from ladarreg_core.formats.documents.pose_file import write_pose
from ladarreg_core.formats.e57.header import E57ImageInfo, E57Info, contents_of, read_e57_info, sniff_e57
from ladarreg_core.formats.e57.tree import SIGNATURE, E57File, open_e57
from ladarreg_core.formats.parsing.untrusted import PathLike, reading
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid

_OPENCV_FROM_E57 = {
    "pinhole": Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3)),  # E57: x right, y up, looking along -z
    # The middle of a spherical image lies along x, its top along z, and its azimuth grows to the left.
    "spherical": Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3)),
}
# E57 counts from the outer corner of the first pixel, ours is its centre. So do its writers: a face of a cube has its
# principal point at half its width and a focal length of the same, whose outer borders are then 45 degrees away.
_FIRST_CENTRE_PX = 0.5
_WHOLE_TURN_TOLERANCE = 1e-3
_STARTS = {"jpeg": b"\xff\xd8", "png": b"\x89PNG"}


@dataclass(frozen=True, slots=True)
class ExtractedImage:
    """Paths of one extracted image."""

    picture: Path
    camera: Path | None
    """Camera file; None where the E57 gives no usable camera."""
    pose: Path | None
    """Pose file (`camera_from_scanner`); None where the E57 gives no pose."""


class ExtractedImages(list[ExtractedImage]):
    """The extracted images, and what is said of those that are damaged."""

    damaged: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class EmbeddedImage:
    """One embedded image as it offers itself, before it is extracted."""

    name: str
    """File name for it."""
    said: str
    """What the file states of it, in one line."""
    is_usable: bool
    """Whether it can be a photograph: cylindrical images and spherical ones of unknown extent cannot."""
    camera: CameraModel | None
    """Camera; None where the file gives no usable one."""
    camera_from_scanner: Rigid | None
    """Pose; None where the file gives none."""


def embedded_images(path: PathLike, scan_index: int = 0) -> tuple[EmbeddedImage, ...]:
    """Return the images embedded in a scan's file, in its order; none if it is not an E57.

    Args:
        path: the file.
        scan_index: index of the scan that the poses are relative to.

    Raises:
        FormatError: if it is damaged.
    """
    with reading(path) as file:
        with open(file, "rb") as stream:
            if not sniff_e57(stream.read(len(SIGNATURE))):
                return ()
        info = read_e57_info(file)
        return tuple(_offer(number, image, info, scan_index) for number, image in enumerate(info.images, 1))


def embedded_data(path: PathLike, index: int) -> ByteArray:
    """Return the content of an embedded image's file.

    Raises:
        FormatError: if there is no such image, or it is damaged.
    """
    with reading(path) as file, open_e57(file) as opened:
        images = contents_of(opened).images
        if not 0 <= index < len(images):
            raise FormatError(f"there is no image {index} in it; it has {len(images)}")
        return np.frombuffer(_blob(opened, images[index]), np.uint8)


def _offer(number: int, image: E57ImageInfo, info: E57Info, scan_index: int) -> EmbeddedImage:
    camera, pose = camera_of_image(image), camera_from_scanner_of(image, info, scan_index)
    words = [f"{image.width} x {image.height}"]
    is_usable = image.kind in ("pinhole", "visual reference") or camera is not None
    if not is_usable:
        words.append(f"{image.kind}, which is not registered")
    elif camera is None:
        words.append("no camera is stated")
    elif camera.as_panorama is not None:
        words.append("spherical panorama")
    else:
        words.append(f"f {camera.focal_px:.0f} px as stated")
    if pose is not None:
        words.append(f"pose stated, {np.linalg.norm(pose.inverse.translation):.2f} m from the scanner")
    name = f"{_slug(image.name) if image.name else number}.{'jpg' if image.format == 'jpeg' else 'png'}"
    return EmbeddedImage(name, ", ".join(words), is_usable, camera, pose)


def extract_images(path: PathLike, folder: PathLike, *, scan_index: int = 0) -> ExtractedImages:
    """Write the images embedded in an E57 file, with their cameras and poses.

    Args:
        path: the E57 file.
        folder: output folder; created if necessary. No file in it is overwritten.
        scan_index: index of the scan that the poses are relative to.

    Returns:
        The written files, in the E57's order; empty if there are no images. Damaged images are left out, and listed.

    Raises:
        FormatError: if the file is not an E57 or is damaged, or all its images are.
        ExportError: if a file exists already or cannot be written.
        OptionError: if there is no scan with that index.
    """
    with reading(path) as file, open_e57(file) as opened:
        info = contents_of(opened)
        if info.scans and not 0 <= scan_index < len(info.scans):
            raise OptionError(f"there is no scan {scan_index}; the file contains {len(info.scans)}")
        target = Path(folder)
        names = [f"{k:02d}_{_slug(image.name)}" for k, image in enumerate(info.images)]
        for name in names:
            if taken := next(iter(target.glob(f"{name}.*")), None):
                raise ExportError(f"{taken.name} exists already; give another folder")
        if not info.images:
            return ExtractedImages()
        intact, damaged = _blobs(opened, info)
        try:
            target.mkdir(parents=True, exist_ok=True)
            found = ExtractedImages(
                _write(target / names[k], info.images[k], blob, info, scan_index) for k, blob in intact.items()
            )
            found.damaged = damaged
            return found
        except OSError as error:
            raise ExportError(f"the images cannot be written: {error.strerror}; check the folder") from error


def camera_of_image(image: E57ImageInfo) -> CameraModel | None:
    """Return the camera of an embedded image, or None where the file gives no usable one.

    An OpenCV distortion block with a focal length takes precedence over the ideal pinhole.
    """
    n = image.numbers
    try:
        if image.kind == "spherical":
            return _spherical_camera(image)
        if image.kind != "pinhole":
            return None
        if n.get("CV_FX", 0) > 0 and n.get("CV_FY", 0) > 0:
            terms = [n.get(f"CV_{name}", 0.0) for name in ("K1", "K2", "P1", "P2", "K3", "K4", "K5", "K6")]
            return Camera(
                image.width, image.height, n["CV_FX"], n["CV_FY"], n.get("CV_CX", 0), n.get("CV_CY", 0), tuple(terms)
            )
        focal, across, down = (n.get(name, 0) for name in ("focalLength", "pixelWidth", "pixelHeight"))
        if min(focal, across, down) <= 0:
            return None
        return Camera(
            image.width,
            image.height,
            focal / across,
            focal / down,
            n.get("principalPointX", image.width / 2) - _FIRST_CENTRE_PX,
            n.get("principalPointY", image.height / 2) - _FIRST_CENTRE_PX,
        )
    except CameraError:
        return None


def _spherical_camera(image: E57ImageInfo) -> EquirectangularCamera | None:
    """Return the camera of a spherical image, whose middle has azimuth and elevation 0."""
    steps = [image.numbers.get(name, 0.0) for name in ("pixelWidth", "pixelHeight")]
    if not all(np.isfinite(step) and step > 0 for step in steps):
        return EquirectangularCamera(image.width, image.height) if image.width == 2 * image.height > 0 else None
    halves = [np.degrees(step * side / 2) for step, side in zip(steps, (image.width, image.height), strict=True)]
    if halves[0] > 180 * (1 + _WHOLE_TURN_TOLERANCE) or halves[1] > 90 * (1 + _WHOLE_TURN_TOLERANCE):
        return None
    right, top = (  # steps are often rounded: a whole turn is meant
        limit if abs(half / limit - 1) < _WHOLE_TURN_TOLERANCE else float(half)
        for half, limit in zip(halves, (180.0, 90.0), strict=True)
    )
    return EquirectangularCamera(image.width, image.height, (-right, top, right, -top))


def camera_from_scanner_of(image: E57ImageInfo, info: E57Info, scan_index: int = 0) -> Rigid | None:
    """Return the pose of an image relative to a scan; None without a pose.

    Poses of scans and images are in the coordinates of the file, so that any scan will do, whether or not the image is
    linked to it.
    """
    if image.world_from_image is None or not 0 <= scan_index < len(info.scans):
        return None
    world_from_scanner = info.scans[scan_index].world_from_scanner or Rigid.identity()
    axes = _OPENCV_FROM_E57.get(image.kind, _OPENCV_FROM_E57["pinhole"])
    return axes @ image.world_from_image.inverse @ world_from_scanner


def _blobs(file: E57File, info: E57Info) -> tuple[dict[int, bytes], tuple[str, ...]]:
    """Return the data of the intact images by index, together no larger than the file, and what is wrong with others.

    Raises:
        FormatError: if none is intact.
    """
    intact: dict[int, bytes] = {}
    damaged: list[FormatError] = []
    for k, image in enumerate(info.images):
        try:
            intact[k] = _blob(file, image)
        except FormatError as error:
            damaged.append(error)
    if not intact:
        raise damaged[0]
    return intact, tuple(map(str, damaged))


def _blob(file: E57File, image: E57ImageInfo) -> bytes:
    data = file.blob(image.offset, image.bytes).tobytes()
    if not data.startswith(_STARTS[image.format]):
        raise FormatError(
            f"the image {image.name!r} is not the {image.format.upper()} that the E57 declares; it is damaged"
        )
    return data


def _write(stem: Path, image: E57ImageInfo, data: bytes, info: E57Info, scan_index: int) -> ExtractedImage:
    picture = stem.with_name(f"{stem.name}.{'jpg' if image.format == 'jpeg' else 'png'}")
    picture.write_bytes(data)
    camera, pose = camera_of_image(image), camera_from_scanner_of(image, info, scan_index)
    camera_path = stem.with_name(f"{stem.name}.camera.json") if camera else None
    pose_path = stem.with_name(f"{stem.name}.pose.json") if camera and pose else None
    if camera and camera_path:
        write_camera(camera_path, camera)
    if pose and pose_path:
        write_pose(pose_path, pose)
    return ExtractedImage(picture, camera_path, pose_path)


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:40] or "image"
