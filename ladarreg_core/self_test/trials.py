"""The trials of a self-test: made photographs without a guess, from starts that are off, and of other places."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.auto import AutoOptions
from ladarreg_core.photo import Photo
from ladarreg_core.progress import Progress, Report
from ladarreg_core.registration import RegisterOptions, register
from ladarreg_core.scan import Scan
from ladarreg_core.self_test.made_photo import MadePhoto, another_place, made_photo, random_pose

TrialKind = Literal["right", "start", "wrong"]

START_LEVELS_DEG = (3.0, 6.0, 12.0)
"""How far the starts are turned; they are moved by as much of the range as that angle's arc."""
_RIGHT_PX = 3.0
_LEAST_COVERED = 0.5
_POSE_TRIES = 20
_LARGEST_SIDE = 1280
_PROBES = 4000


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfTestOptions:
    """How much is tried."""

    photos: int = 20
    """Photographs without any guess."""
    starts: int = 9
    """Photographs from a start that is off, by each of `START_LEVELS_DEG` in turn."""
    wrong: int = 10
    """Pictures of other places."""
    seconds: float = 120.0
    """It ends when this time is over; the kinds of trials take turns, so that each has had its share."""
    seed: int = 0
    """Of every draw."""

    def __post_init__(self) -> None:
        for name in ("photos", "starts", "wrong"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 10_000:
                raise OptionError(f"{name} is {value!r}; it must be a whole number from 0 to 10,000")
        if self.photos + self.starts + self.wrong == 0:
            raise OptionError("nothing is to be tried; ask for some photos, starts or wrong places")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or not 0 <= self.seed < 2**31:
            raise OptionError(f"the seed is {self.seed!r}; it must be a whole number of at least 0")
        try:
            sensible = 1 <= float(self.seconds) <= 1e6
        except (TypeError, ValueError):
            sensible = False
        if not sensible:
            raise OptionError(f"seconds is {self.seconds!r}; it must be a number from 1 to a million")


@dataclass(frozen=True, slots=True)
class Trial:
    """One registration of a made photograph."""

    kind: TrialKind
    """`right`: no guess; `start`: looked for near a start that is off; `wrong`: a picture of another place."""
    accepted: bool
    """Whether it was called registered."""
    error_px: float
    """Median displacement of what the photo sees, px; NaN without a pose, and of another place."""
    error_mm: float
    """How far the camera's centre is off, mm; NaN likewise."""
    error_deg: float
    """How far it is turned, deg; NaN likewise."""
    off_deg: float
    """How far the start was turned; 0 without one."""
    seconds: float
    """Wall time of the registration."""

    @property
    def right(self) -> bool:
        """Whether it ended as it should."""
        if self.kind == "wrong":
            return not self.accepted
        return self.accepted and self.error_px <= _RIGHT_PX


def run_trials(
    scan: Scan, camera: Camera, options: SelfTestOptions | None = None, *, report: Report | None = None
) -> Iterator[Trial]:
    """Yield trials as they end, until all are made or the time is over.

    Args:
        scan: the scan.
        camera: the camera that photographs of it are taken with; a large one is tried at 1280 px.
        options: how much.
        report: told before each; may raise `Cancelled`.

    Raises:
        DegenerateGeometryError: if no camera beside the scanner sees enough of the scan.
    """
    o = options or SelfTestOptions()
    shrink = min(1.0, _LARGEST_SIDE / max(camera.size))
    camera = camera if shrink == 1.0 else camera.scaled(shrink)
    plan = _turns(o)
    begun = time.perf_counter()
    for number, (kind, off_deg) in enumerate(plan):
        spent = time.perf_counter() - begun
        if number and spent * (1 + 1 / number) > o.seconds:  # the next would end late
            return
        if report is not None:
            report(Progress(number, len(plan), f"trial {number + 1} of {len(plan)}"))
        rng = np.random.default_rng([o.seed, number])
        yield _tried(scan, _seen(scan, camera, rng), kind, off_deg, rng, number)


def _turns(o: SelfTestOptions) -> list[tuple[TrialKind, float]]:
    """Return what to try, each kind spread evenly over the whole."""
    kinds: list[tuple[float, TrialKind, float]] = []
    for count, kind in ((o.photos, "right"), (o.starts, "start"), (o.wrong, "wrong")):
        for k in range(count):
            off = START_LEVELS_DEG[k % len(START_LEVELS_DEG)] if kind == "start" else 0.0
            kinds.append(((k + 0.5) / count, kind, off))  # type: ignore[arg-type]
    return [(kind, off) for _, kind, off in sorted(kinds, key=lambda entry: entry[0])]


def _seen(scan: Scan, camera: Camera, rng: np.random.Generator) -> MadePhoto:
    """Return a made photograph that shows enough of the scan."""
    best: MadePhoto | None = None
    for _ in range(_POSE_TRIES):
        pose = random_pose(scan, camera, rng)
        if _share_seen(scan, camera, pose) == 0:
            continue
        made = made_photo(scan, camera, pose, rng)
        if made.covered >= _LEAST_COVERED:
            return made
        if best is None or made.covered > best.covered:
            best = made
    if best is None or best.covered < _LEAST_COVERED / 2:
        raise DegenerateGeometryError(
            "no camera beside the scanner sees enough of the scan to try it; give the camera of the photographs, or a "
            "denser scan"
        )
    return best


def _share_seen(scan: Scan, camera: Camera, pose: Rigid) -> float:
    return float(np.mean(camera.contains(camera.project(pose @ _probes(scan)))))


def _probes(scan: Scan) -> np.ndarray:
    points = np.asarray(scan.points, dtype=np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, len(points) // _PROBES)]


def _tried(
    scan: Scan, made: MadePhoto, kind: TrialKind, off_deg: float, rng: np.random.Generator, number: int
) -> Trial:
    photo, start = made.photo, None
    if kind == "wrong":
        photo = another_place(photo, number)
    elif kind == "start":
        start = _off(made.camera_from_scanner, off_deg, float(np.nanmedian(scan.ranges)), rng)
    begun = time.perf_counter()
    accepted, pose = _registered(scan, photo, start)
    seconds = time.perf_counter() - begun
    if kind == "wrong" or pose is None:
        return Trial(kind, accepted, float("nan"), float("nan"), float("nan"), off_deg, seconds)
    truth = made.camera_from_scanner
    points = _probes(scan)
    uv = photo.camera.project(truth @ points)
    seen = photo.camera.contains(uv)
    shift = np.linalg.norm(photo.camera.project(pose @ points[seen]) - uv[seen], axis=1)
    error_px = float(np.median(np.where(np.isfinite(shift), shift, np.inf))) if seen.any() else float("inf")
    return Trial(
        kind, accepted, error_px, 1000 * pose.distance_to(truth), float(np.degrees(pose.angle_to(truth))), off_deg,
        seconds,
    )  # fmt: skip


def _off(truth: Rigid, degrees: float, reach: float, rng: np.random.Generator) -> Rigid:
    """Return a start that is turned by so many degrees and moved by as long an arc of the range, any way."""
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    angle = np.deg2rad(degrees)
    return Rigid.from_centre(rotation_from_rotvec(axis * angle) @ truth.rotation, truth.centre + angle * reach * way)


def _registered(scan: Scan, photo: Photo, start: Rigid | None) -> tuple[bool, Rigid | None]:
    """Return whether a photograph was accepted, and the pose; with a start, near that alone."""
    auto = AutoOptions(reach="everywhere" if start is None else "near_start")
    result = register(scan, photo, initial=start, options=RegisterOptions(auto=auto))
    return result.accepted, result.camera_from_scanner
