"""What a worker process does for one photograph: register it, and write its results."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.batches.photos.pooled_camera import (
    CameraEstimate,
    PooledCamera,
    camera_estimate,
    with_pooled_camera,
)
from ladarreg_core.camera.model import CameraModel
from ladarreg_core.camera.uncertainty import CameraPrior
from ladarreg_core.errors import OptionError
from ladarreg_core.export.output_frame import FrameName
from ladarreg_core.export.targets.folder import export_registration
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.encoded_image import encoded_image
from ladarreg_core.foundations.source import with_source
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.kept_channels import Channels
from ladarreg_core.photo import Photo
from ladarreg_core.quality.assessment import assess
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.results.registration import Registration
from ladarreg_core.results.verdict_words import verdict_words
from ladarreg_core.scan import Scan

_CHANNEL_BYTES = 400_000_000
_HELD_CELLS = 8_000_000  # of several scans together
_THUMBNAIL_PX = 240
_THUMBNAIL_QUALITY = 80


@dataclass(frozen=True, slots=True)
class ScanFiles:
    """A scan as worker processes get it: from the cache where it is kept, else from its files."""

    path: Path | None
    """None: it has no file, and is in the cache only."""
    options: Mapping[str, Any]
    """Arguments of `read_scan`."""
    key: str
    """Its key in the cache."""
    cache: Path = Path()
    """The cache's folder."""
    cache_bytes: int = 0
    """Its size; 0: there is none."""

    @property
    def files(self) -> list[Path]:
        """All its files."""
        return [] if self.path is None else [self.path, *self.options.get("more", ())]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoTask:
    """One photograph, and how it is registered."""

    id: str
    path: Path
    options: Mapping[str, Any]
    """Arguments of `read_photo`."""
    orientation: int
    """EXIF's, by which its pixels are turned upright."""
    scan: ScanFiles
    registering: RegisterOptions
    camera: PooledCamera | None = None
    """The camera pooled over the photographs of its group; None: that of the photograph itself."""
    start: Rigid | None = None
    """A pose found without the pooled camera that agrees with it."""
    found: Registration | None = None
    """The registration without the pooled camera, if it has been done."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """Where the results of a photograph are written, and how."""

    folder: Path
    frame: FrameName
    force: bool
    apart_from: tuple[Path, ...] = ()


def estimate_in_worker(task: PhotoTask) -> tuple[Registration, CameraEstimate | None]:
    """Register a photograph by itself, and return what it says of its camera; None: nothing that can be pooled.

    Raises:
        LadarregError: if it cannot be read or registered.
    """
    result = _register_alone(task)
    return result, camera_estimate(task.id, result, task.orientation)


def register_in_worker(task: PhotoTask, output: Output) -> dict[str, Any]:
    """Register a photograph with the pooled camera, if there is one, and write its folder of results.

    Returns:
        What the summary says of it, JSON-ready.

    Raises:
        LadarregError: if it cannot be read or registered, or the folder cannot be written.
    """
    scan, photo = held_scan(task.scan), read_photo(task.path, **task.options)
    if task.camera is None:
        result = task.found or _register_alone(task)
    else:
        result, photo = _with_camera(task, scan, photo, task.camera)
    camera_file = task.options.get("camera")
    inputs = [*task.scan.files[:1], task.path, *([camera_file] if camera_file else []), *task.scan.files[1:]]
    export_registration(
        output.folder, result.untimed, scan, photo, assessment=assess(scan, result), inputs=inputs,
        read_with=[task.scan.options, task.options], frame=output.frame, force=output.force,
    )  # fmt: skip
    return summary_fields(result, photo)


def summary_fields(result: Registration, photo: Photo) -> dict[str, Any]:
    """Return what the summary of a run says of a photograph, JSON-ready."""
    known = bool(np.isfinite(result.covariance).all())
    shown, world = result.is_shown, result.camera_from_world
    return {
        "camera_from_scanner": result.camera_from_scanner.matrix.tolist() if shown else None,
        "camera_from_world": world.matrix.tolist() if shown and world is not None else None,
        "covariance": result.covariance.tolist() if shown and known else None,
        "accepted": bool(result.accepted),
        "evidence": result.evidence,
        "precision": "coarse" if result.accepted and result.is_coarse else None,
        "verdict": verdict_words(result.accepted, result.evidence, result.diagnostics, coarse=result.is_coarse),
        "reasons": list(result.reasons),
        "sigma": {"angle_rad": result.sigma_angle_rad, "position_m": result.sigma_position_m}
        if shown and known
        else None,
        "camera": result.camera.as_fields(),
        "camera_sigmas": dict(result.camera_sigmas),
        "notes": list(photo.notes),
        "thumbnail": thumbnail(photo.pixels),
    }


def thumbnail(pixels: ByteArray) -> str:
    """Return a small JPEG of a picture (H, W, 3), in Base64."""
    height, width = pixels.shape[:2]
    scale = min(1.0, _THUMBNAIL_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    data = encoded_image(small, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY])
    return base64.b64encode(data).decode("ascii")


def _register_alone(task: PhotoTask) -> Registration:
    return _registered(task, held_scan(task.scan), read_photo(task.path, **task.options), task.registering)


def _registered(
    task: PhotoTask, scan: Scan, photo: Photo, options: RegisterOptions, initial: Rigid | None = None
) -> Registration:
    return register(scan, photo, initial=initial, options=options, channels=kept_channels(), threads=1)


def _with_camera(task: PhotoTask, scan: Scan, photo: Photo, pooled: PooledCamera) -> tuple[Registration, Photo]:
    """Return the registration with the pooled camera, and the photograph with it.

    A pose that agrees with that camera is only refined. Any other photograph is searched everywhere, and one that is
    not accepted then has another camera or was not taken here.
    """
    camera = pooled.camera(*photo.camera.size, task.orientation)
    seen = replace(photo, camera=camera, calibrated=True, assumed=False, alternatives=())
    options = _with_prior(task.registering, pooled, camera)
    if task.start is not None:
        near = replace(options, auto=replace(options.auto, reach="near_start"))
        result = _registered(task, scan, seen, near, task.start)
        if not result.accepted:  # one photograph may constrain the camera less than all together
            alone = task.found or _register_alone(task)
            return replace(alone, reasons=(*alone.reasons, _kept_alone(pooled))), photo
    else:
        result = _registered(task, scan, seen, options)
    result = with_pooled_camera(result, pooled, task.orientation)
    if task.id not in pooled.disagreeing:
        return replace(result, reasons=(*result.reasons, _pooled_sentence(pooled))), seen
    sentence = _disagreed_sentence(pooled, accepted=result.accepted)
    reasons = (*result.reasons, sentence) if result.accepted else (sentence, *result.reasons)
    return replace(result, reasons=reasons), seen


def _with_prior(options: RegisterOptions, pooled: PooledCamera, camera: CameraModel) -> RegisterOptions:
    """Return options for a camera that is known as well as the pooled one, and no better than a calibrated one."""
    known, sigmas = options.auto.calibrated_prior, pooled.sigmas
    centre = max(sigmas["cx"], sigmas["cy"]) / camera.size[0]
    prior = CameraPrior(
        focal=max(known.focal, min(1.0, sigmas["focal_px"] / float(pooled.values[0]))),
        centre_of_width=max(known.centre_of_width, min(1.0, centre)),
        k1=max(known.k1, sigmas["k1"]),
    )
    return replace(options, auto=replace(options.auto, calibrated_prior=prior))


def _pooled_sentence(pooled: PooledCamera) -> str:
    return (
        f"Its camera is that of {len(pooled.photos)} photographs together: focal length {pooled.values[0]:.1f} +- "
        f"{pooled.sigmas['focal_px']:.1f} px, k1 {pooled.values[1]:.3f} +- {pooled.sigmas['k1']:.3f}."
    )


def _kept_alone(pooled: PooledCamera) -> str:
    return (
        f"The images do not confirm the camera of {len(pooled.photos)} photographs together (focal length "
        f"{pooled.values[0]:.1f} px), although both agree; its own is kept."
    )


def _disagreed_sentence(pooled: PooledCamera, *, accepted: bool) -> str:
    focal = f"{pooled.values[0]:.1f} +- {pooled.sigmas['focal_px']:.1f} px"
    if accepted:
        return f"By itself it showed another camera than the other photographs; with theirs ({focal}) it is confirmed."
    return (
        f"By itself it fits with another camera than the {len(pooled.photos)} photographs of the same body, lens and "
        f"size ({focal}), and with theirs it does not: it was zoomed or cropped, or was registered wrongly. If it has "
        "a camera of its own, register it by itself."
    )


@cache
def kept_channels() -> Channels:
    """Return what this process has made of scans and photographs for the work that follows."""
    return Channels(most_bytes=_CHANNEL_BYTES)


_held: dict[str, Scan] = {}


def held_scan(files: ScanFiles) -> Scan:
    """Return a scan, which this process keeps for the photographs that follow; small ones, also several.

    Raises:
        LadarregError: if it is not in the cache any more, and cannot be read.
    """
    if files.key not in _held:
        cached = ContentCache(files.cache, most_bytes=files.cache_bytes)
        kept = cached.get(files.key) if files.cache_bytes else None
        if isinstance(kept, Scan):
            scan = with_source(kept, files.files, files.options) if files.path is not None else kept
        elif files.path is None:
            raise OptionError("the scan is not in the cache any more, which is too small; give a larger one")
        else:
            scan = read_scan(files.path, **files.options)
        while _held and sum(one.ranges.size for one in _held.values()) + scan.ranges.size > _HELD_CELLS:
            del _held[next(iter(_held))]
        _held[files.key] = scan
    return _held[files.key]
