"""What a worker process does for a survey: features, matches, registrations, and places on the laser's surface.

What costs time is kept in the cache by content, so that a survey which is interrupted, or adjusted again with another
photograph, does not do it twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.batches.photos.photo_task import ScanFiles, held_scan, kept_channels
from ladarreg_core.camera import CameraModel
from ladarreg_core.export.json import input_document, plain
from ladarreg_core.formats import read_matches, read_photo
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.results.registration import Registration
from ladarreg_core.survey.colored_view import ColorSource, colored_view
from ladarreg_core.survey.ties.features import MAX_FEATURES, Features, detect, matches_between
from ladarreg_core.survey.ties.ties import LaserPoints, laser_points

T = TypeVar("T")
_TICK_S = 0.25

_held_features: dict[str, Features] = {}
_MAX_HELD = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoFiles:
    """A photograph as worker processes get it."""

    id: str
    source: Path | Photo
    options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of `read_photo`."""
    key: str = ""
    """Key of its content."""

    def read(self) -> Photo:
        """Return the photograph.

        Raises:
            LadarregError: if it cannot be read.
        """
        return self.source if isinstance(self.source, Photo) else read_photo(self.source, **self.options)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairTask:
    """A photograph to be registered on a scan."""

    photo: PhotoFiles
    scan: ScanFiles
    options: RegisterOptions
    camera: CameraModel | None = None
    """Taken as it is; None: that of the photograph, estimated as far as it is assumed."""
    initial: Rigid | None = None
    """A rough `camera_from_scanner`."""
    near: bool = False
    """Look near `initial` only."""
    matches: Path | None = None
    """File of matches to solve."""


def finished(waiting: Iterable[Future[T]], tick: Callable[[], None]) -> Iterator[Future[T]]:
    """Yield futures as they are done, and call `tick` several times a second meanwhile; it may raise to stop."""
    left = set(waiting)
    while left:
        done, left = wait(left, timeout=_TICK_S, return_when=FIRST_COMPLETED)
        tick()
        yield from done


def photo_features(photo: PhotoFiles, cache: Path, cache_bytes: int) -> Features:
    """Return the features of a photograph, from the cache if they are there."""
    store = ContentCache(cache, most_bytes=cache_bytes)
    key = store.key(kind="features", limit=MAX_FEATURES, photo=photo.key)
    if key in _held_features:
        return _held_features[key]
    kept = store.get(key)
    if isinstance(kept, dict):
        found = Features(kept["uv"], kept["descriptors"], kept["scale_px"])
    else:
        found = detect(photo.read().pixels)
        store.put(key, {"uv": found.uv, "descriptors": found.descriptors, "scale_px": found.scale_px})
    if len(_held_features) >= _MAX_HELD:
        del _held_features[next(iter(_held_features))]
    _held_features[key] = found
    return found


def pair_matches(first: PhotoFiles, second: PhotoFiles, cache: Path, cache_bytes: int) -> IntArray:
    """Return the matches (M, 2) of two photographs, from the cache if they are there."""
    store = ContentCache(cache, most_bytes=cache_bytes)
    key = store.key(kind="matches", limit=MAX_FEATURES, photos=[first.key, second.key])
    kept = store.get(key)
    if isinstance(kept, dict):
        return np.asarray(kept["matches"])
    found = matches_between(*(photo_features(one, cache, cache_bytes) for one in (first, second)))
    store.put(key, {"matches": found})
    return found


def registered(task: PairTask) -> Registration:
    """Register a photograph on a scan, or take its registration from the cache.

    Raises:
        LadarregError: if either cannot be read, or the photograph cannot be registered.
    """
    store = ContentCache(task.scan.cache, most_bytes=task.scan.cache_bytes)
    key = store.key(
        kind="registration", photo=task.photo.key, scan=task.scan.key, options=plain(asdict(task.options)),
        camera=None if task.camera is None else task.camera.as_fields(), near=task.near,
        initial=None if task.initial is None else task.initial.matrix.tolist(),
        matches=None if task.matches is None else input_document(task.matches)["sha256"],
    )  # fmt: skip
    kept = store.get(key)
    if isinstance(kept, dict):
        return Registration.from_json(bytes(kept["json"]).decode())
    result = _registered(task)
    store.put(key, {"json": np.frombuffer(result.to_json().encode(), np.uint8)})
    return result


def _registered(task: PairTask) -> Registration:
    scan, photo, options = held_scan(task.scan), task.photo.read(), task.options
    if task.near:
        options = replace(options, auto=replace(options.auto, reach="near_start"))
    if task.camera is not None:
        photo = replace(photo, camera=task.camera, calibrated=True, assumed=False, alternatives=())
        options = replace(options, auto=replace(options.auto, intrinsics="fixed"))
    picks = None if task.matches is None else read_matches(task.matches, scan)
    return register(
        scan, photo, picks=picks, initial=task.initial, options=options, channels=kept_channels(), threads=1
    )


def verified_by_colors(
    task: PairTask,
    sources: tuple[tuple[PhotoFiles, CameraModel, Rigid], ...],
    scans: tuple[tuple[ScanFiles, Rigid], ...],
) -> Registration | None:
    """Register a photograph on the surface as other photographs colour it, near a pose, at its own resolution.

    Args:
        task: the photograph with its camera and its rough `camera_from_world` as `initial`; its scan is ignored.
        sources: photographs that colour the surface, with their cameras and `camera_from_world`.
        scans: the surfaces, with their `scanner_from_world`.

    Returns:
        The registration, whose `camera_from_scanner` is the pose in the world; None: too little of the surface has a
        colour.
    """
    assert task.camera is not None
    assert task.initial is not None
    photo = task.photo.read()
    colors = [ColorSource(one.read(), camera, pose) for one, camera, pose in sources]
    surfaces = [(held_scan(files), pose) for files, pose in scans]
    view = colored_view(task.camera, task.initial, colors, surfaces)
    if view is None:
        return None
    seen = replace(photo, camera=task.camera, calibrated=True, assumed=False, alternatives=())
    near = replace(task.options.auto, reach="near_start", intrinsics="fixed")
    result = register(
        view.scan, seen, initial=view.camera_from_scanner, options=replace(task.options, auto=near), threads=1
    )
    return replace(result, world_from_scanner=view.world_from_scanner)


def laser_under(scan: ScanFiles, camera: CameraModel, camera_from_scanner: Rigid, uv: FloatArray) -> LaserPoints:
    """Return the places of a scan's surface under pixels (N, 2) of a photograph."""
    return laser_points(held_scan(scan), camera, camera_from_scanner, uv)
