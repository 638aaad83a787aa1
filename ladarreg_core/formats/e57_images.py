"""Extraction of the images embedded in E57 files, with their cameras and poses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ladarreg_core.arrays import ByteArray
from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, ExportError, FormatError
from ladarreg_core.formats.camera_file import write_camera
from ladarreg_core.formats.e57 import e57_file
from ladarreg_core.formats.e57_header import SIGNATURE, E57ImageInfo, E57Info, read_e57_info, sniff_e57
from ladarreg_core.formats.pose_file import write_pose
from ladarreg_core.formats.untrusted import PathLike, reading
from ladarreg_core.frames import Rigid

_OPENCV_FROM_E57 = Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # E57: x right, y up, looking along -z
_STARTS = {"jpeg": b"\xff\xd8", "png": b"\x89PNG"}


@dataclass(frozen=True, slots=True)
class ExtractedImage:
    """Paths of one extracted image."""

    picture: Path
    camera: Path | None
    """Camera file; None where the E57 gives no usable camera."""
    pose: Path | None
    """Pose file (`camera_from_scanner`); None where the E57 gives no pose."""


@dataclass(frozen=True, slots=True)
class EmbeddedImage:
    """One embedded image as it offers itself, before it is extracted."""

    name: str
    """File name for it."""
    said: str
    """What the file states of it, in one line."""
    is_perspective: bool
    """Whether it may be registered: panoramas may not."""
    camera: Camera | None
    """Camera; None where the file gives no usable one."""
    camera_from_scanner: Rigid | None
    """Pose; None where the file gives none."""


def embedded_images(path: PathLike) -> tuple[EmbeddedImage, ...]:
    """Return the images embedded in a scan's file, in its order; none if it is not an E57.

    Raises:
        FormatError: if it is damaged.
    """
    with reading(path) as file:
        with open(file, "rb") as stream:
            if not sniff_e57(stream.read(len(SIGNATURE))):
                return ()
        info = read_e57_info(file)
        return tuple(_offer(number, image, info) for number, image in enumerate(info.images, 1))


def embedded_data(path: PathLike, index: int) -> ByteArray:
    """Return the content of an embedded image's file.

    Raises:
        FormatError: if there is no such image, or it is damaged.
    """
    with reading(path) as file:
        images = read_e57_info(file).images
        if not 0 <= index < len(images):
            raise FormatError(f"there is no image {index} in it; it has {len(images)}")
        with e57_file(file) as image_file:
            return np.frombuffer(_blob(image_file, images[index]), np.uint8)


def _offer(number: int, image: E57ImageInfo, info: E57Info) -> EmbeddedImage:
    camera, pose = camera_of_image(image), camera_from_scanner_of(image, info)
    words = [f"{image.width} x {image.height}"]
    is_perspective = image.kind in ("pinhole", "visual reference")
    if not is_perspective:
        words.append(f"{image.kind}, which is not registered")
    elif camera is None:
        words.append("no camera is stated")
    else:
        words.append(f"f {camera.focal_px:.0f} px as stated")
    if pose is not None:
        words.append(f"pose stated, {np.linalg.norm(pose.inverse.translation):.2f} m from the scanner")
    name = f"{_slug(image.name) if image.name else number}.{'jpg' if image.format == 'jpeg' else 'png'}"
    return EmbeddedImage(name, ", ".join(words), is_perspective, camera, pose)


def extract_images(path: PathLike, folder: PathLike) -> list[ExtractedImage]:
    """Write the images embedded in an E57 file, with their cameras and poses.

    Args:
        path: the E57 file.
        folder: output folder; created if necessary. No file in it is overwritten.

    Returns:
        The written files, in the E57's order; empty if there are no images.

    Raises:
        FormatError: if the file is not an E57 or is damaged.
        ExportError: if a file exists already or cannot be written.
    """
    with reading(path) as file:
        info = read_e57_info(file)
        target = Path(folder)
        names = [f"{k:02d}_{_slug(image.name)}" for k, image in enumerate(info.images)]
        for name in names:
            if taken := next(iter(target.glob(f"{name}.*")), None):
                raise ExportError(f"{taken.name} exists already; give another folder")
        if not info.images:
            return []
        with e57_file(file) as image_file:
            blobs = [_blob(image_file, image) for image in info.images]  # together no larger than the file
        try:
            target.mkdir(parents=True, exist_ok=True)
            return [
                _write(target / name, image, blob, info)
                for name, image, blob in zip(names, info.images, blobs, strict=True)
            ]
        except OSError as error:
            raise ExportError(f"the images cannot be written: {error.strerror}; check the folder") from error


def camera_of_image(image: E57ImageInfo) -> Camera | None:
    """Return the camera of an embedded image, or None where the file gives no usable one.

    An OpenCV distortion block with a focal length takes precedence over the ideal pinhole.
    """
    n = image.numbers
    if image.kind != "pinhole":
        return None
    try:
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
            n.get("principalPointX", (image.width - 1) / 2),
            n.get("principalPointY", (image.height - 1) / 2),
        )
    except CameraError:
        return None


def camera_from_scanner_of(image: E57ImageInfo, info: E57Info) -> Rigid | None:
    """Return the pose of an image relative to its associated scan (else the first scan); None without a pose."""
    if image.world_from_image is None or not info.scans:
        return None
    scan = next((s for s in info.scans if s.guid and s.guid == image.associated_guid), info.scans[0])
    world_from_scanner = scan.world_from_scanner or Rigid.identity()
    return _OPENCV_FROM_E57 @ image.world_from_image.inverse @ world_from_scanner


def _blob(image_file: object, image: E57ImageInfo) -> bytes:
    node: object = image_file.root()  # type: ignore[attr-defined]
    for step in image.blob_path:
        node = node[step]  # type: ignore[index]
    data = bytes(node.read_buffer())  # type: ignore[attr-defined]
    if not data.startswith(_STARTS[image.format]):
        raise FormatError(
            f"the image {image.name!r} is not the {image.format.upper()} that the E57 declares; it is damaged"
        )
    return data


def _write(stem: Path, image: E57ImageInfo, data: bytes, info: E57Info) -> ExtractedImage:
    picture = stem.with_name(f"{stem.name}.{'jpg' if image.format == 'jpeg' else 'png'}")
    picture.write_bytes(data)
    camera, pose = camera_of_image(image), camera_from_scanner_of(image, info)
    camera_path = stem.with_name(f"{stem.name}.camera.json") if camera else None
    pose_path = stem.with_name(f"{stem.name}.pose.json") if camera and pose else None
    if camera and camera_path:
        write_camera(camera_path, camera)
    if pose and pose_path:
        write_pose(pose_path, pose)
    return ExtractedImage(picture, camera_path, pose_path)


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:40] or "image"
