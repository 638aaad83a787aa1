"""Trials of a self-test: synthetic photos without an initial pose, with a wrong initial pose, and unrelated photos."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import LARGEST_INT, require_int
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.images.support import is_coarse
from ladarreg_core.photo import Photo
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.registration.self_test.synthetic_photo import (
    FARTHEST_REACH_M,
    SyntheticPhoto,
    random_pose,
    render_photo,
    unrelated_photo,
)
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import native_focal_px

TrialKind = Literal["right", "start", "wrong"]

START_LEVELS_DEG = (3.0, 6.0, 12.0)
"""Rotation errors of the initial poses; their position errors are the arc of that angle at the median range, or at 5 m
if that is nearer."""
_RIGHT_PX, _RIGHT_CELLS = 3.0, 3.0
_MIN_COVERED = 0.5
_POSE_TRIES = 20
_LARGEST_SIDE = 1280
_SAMPLE_POINTS = 4000


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfTestOptions:
    """Number and kind of trials."""

    photos: int = 20
    """Photos without an initial pose."""
    starts: int = 9
    """Photos with a wrong initial pose, off by each of `START_LEVELS_DEG` in turn."""
    wrong: int = 10
    """Unrelated photos."""
    seconds: float = 120.0
    """Time limit; the kinds of trials alternate, so that each gets its share."""
    seed: int = 0
    """Random seed; equal seeds give equal results."""

    def __post_init__(self) -> None:
        for name in ("photos", "starts", "wrong"):
            value = getattr(self, name)
            require_int(value, f"{name}", least=0, most=10_000)
        if self.photos + self.starts + self.wrong == 0:
            raise OptionError("there are no trials; set photos, starts or wrong above 0")
        require_int(self.seed, "the seed", least=0, most=LARGEST_INT)
        try:
            sensible = 1 <= float(self.seconds) <= 1e6
        except (TypeError, ValueError):
            sensible = False
        if not sensible:
            raise OptionError(f"seconds is {self.seconds!r}; it must be a number from 1 to a million")


@dataclass(frozen=True, slots=True)
class Trial:
    """One registration of a synthetic or unrelated photo."""

    kind: TrialKind
    """`right`: without an initial pose; `start`: near a wrong initial pose; `wrong`: an unrelated photo."""
    accepted: bool
    """Whether the registration was accepted."""
    error_px: float
    """Median displacement of the scan in the photo, px; NaN without a pose, and for unrelated photos."""
    error_mm: float
    """Error of the camera position, mm; NaN likewise."""
    error_deg: float
    """Error of the camera orientation, deg; NaN likewise."""
    off_deg: float
    """Rotation error of the initial pose; 0 without one."""
    seconds: float
    """Wall-clock time of the registration."""
    limit_px: float = _RIGHT_PX
    """Largest error that counts as right: of a coarse scan, that of three cells."""

    @property
    def right(self) -> bool:
        """Whether the outcome is correct."""
        if self.kind == "wrong":
            return not self.accepted
        return self.accepted and self.error_px <= self.limit_px


def run_trials(
    scan: Scan, camera: Camera, options: SelfTestOptions | None = None, *, report: Report | None = None
) -> Iterator[Trial]:
    """Yield trials as they finish, until all are done or the time is over.

    Args:
        scan: the scan.
        camera: the camera of the photographs; a large one is reduced to 1280 px.
        options: number of trials, and time limit.
        report: called before each trial; may raise `Cancelled`.

    Raises:
        DegenerateGeometryError: if no camera beside the scanner sees enough of the scan.
    """
    o = options or SelfTestOptions()
    shrink = min(1.0, _LARGEST_SIDE / max(camera.size))
    camera = camera if shrink == 1.0 else camera.scaled(shrink)
    plan = _plan(o)
    begun = time.perf_counter()
    for number, (kind, off_deg) in enumerate(plan):
        spent = time.perf_counter() - begun
        if number and spent * (1 + 1 / number) > o.seconds:  # the next would exceed the limit
            return
        if report is not None:
            report(Progress(number, len(plan), f"trial {number + 1} of {len(plan)}"))
        rng = np.random.default_rng([o.seed, number])
        yield _run_trial(scan, _photo_of_scan(scan, camera, rng), kind, off_deg, rng, number)


def _plan(o: SelfTestOptions) -> list[tuple[TrialKind, float]]:
    """Return kind and start error of each trial, the kinds spread evenly."""
    kinds: list[tuple[float, TrialKind, float]] = []
    for count, kind in ((o.photos, "right"), (o.starts, "start"), (o.wrong, "wrong")):
        for k in range(count):
            off = START_LEVELS_DEG[k % len(START_LEVELS_DEG)] if kind == "start" else 0.0
            kinds.append(((k + 0.5) / count, kind, off))  # type: ignore[arg-type]
    return [(kind, off) for _, kind, off in sorted(kinds, key=lambda entry: entry[0])]


def _photo_of_scan(scan: Scan, camera: Camera, rng: np.random.Generator) -> SyntheticPhoto:
    """Return a synthetic photo that shows enough of the scan."""
    best: SyntheticPhoto | None = None
    for _ in range(_POSE_TRIES):
        pose = random_pose(scan, camera, rng)
        if _visible_share(scan, camera, pose) == 0:
            continue
        made = render_photo(scan, camera, pose, rng)
        if made.covered >= _MIN_COVERED:
            return made
        if best is None or made.covered > best.covered:
            best = made
    if best is None or best.covered < _MIN_COVERED / 2:
        raise DegenerateGeometryError(
            "no camera beside the scanner sees enough of the scan for a self-test; give the actual camera of the "
            "photographs, or a denser scan"
        )
    return best


def _visible_share(scan: Scan, camera: Camera, pose: Rigid) -> float:
    return float(np.mean(camera.contains(camera.project(pose @ _sample_points(scan)))))


def _sample_points(scan: Scan) -> np.ndarray:
    points = np.asarray(scan.points, dtype=np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, len(points) // _SAMPLE_POINTS)]


def _run_trial(
    scan: Scan, made: SyntheticPhoto, kind: TrialKind, off_deg: float, rng: np.random.Generator, number: int
) -> Trial:
    photo, start = made.photo, None
    if kind == "wrong":
        photo = unrelated_photo(photo, number)
    elif kind == "start":
        reach = min(float(np.nanmedian(scan.ranges)), FARTHEST_REACH_M)
        start = _wrong_start(made.camera_from_scanner, off_deg, reach, rng)
    begun = time.perf_counter()
    accepted, pose = _register(scan, photo, start)
    seconds = time.perf_counter() - begun
    if kind == "wrong" or pose is None:
        return Trial(kind, accepted, float("nan"), float("nan"), float("nan"), off_deg, seconds)
    truth = made.camera_from_scanner
    points = _sample_points(scan)
    uv = photo.camera.project(truth @ points)
    seen = photo.camera.contains(uv)
    shift = np.linalg.norm(photo.camera.project(pose @ points[seen]) - uv[seen], axis=1)
    error_px = float(np.median(np.where(np.isfinite(shift), shift, np.inf))) if seen.any() else float("inf")
    return Trial(
        kind, accepted, error_px, 1000 * pose.distance_to(truth), float(np.degrees(pose.angle_to(truth))), off_deg,
        seconds, _limit_px(scan, photo.pinhole),
    )  # fmt: skip


def _limit_px(scan: Scan, camera: Camera) -> float:
    cell_px = camera.focal_px / native_focal_px(scan) if is_coarse(scan, camera) else 0.0
    return max(_RIGHT_PX, _RIGHT_CELLS * cell_px)


def _wrong_start(truth: Rigid, degrees: float, reach: float, rng: np.random.Generator) -> Rigid:
    """Return a pose rotated by this angle and moved by its arc at the range, both in random directions."""
    axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    angle = np.deg2rad(degrees)
    return Rigid.from_centre(
        rotation_from_rotvec(axis * angle) @ truth.rotation, truth.centre + angle * reach * direction
    )


def _register(scan: Scan, photo: Photo, start: Rigid | None) -> tuple[bool, Rigid | None]:
    """Register a photo, near the initial pose only if there is one; return whether it was accepted, and the pose."""
    auto = AutoOptions(reach="everywhere" if start is None else "near_start")
    result = register(scan, photo, initial=start, options=RegisterOptions(auto=auto))
    return result.accepted, result.camera_from_scanner
