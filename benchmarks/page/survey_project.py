"""A large survey as a project, simulated cheaply: many stations in one room, and many photographs with known poses."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from msgspec.structs import replace

from ladarreg_core.camera import Camera
from ladarreg_core.formats.scans.npz import write_npz_panorama
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.matches import Matches
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.project import edits
from ladarreg_core.project.document import (
    Adjusted,
    AdjustedPhotoEntry,
    AdjustedScanEntry,
    CameraGiven,
    Document,
    PhotoEntry,
)
from ladarreg_core.project.history import NOBODY
from ladarreg_core.project.results import pose_entry
from ladarreg_core.project.source import Source
from ladarreg_core.project.station_edits import with_stations
from ladarreg_core.results.registration import PoseResult, Registration
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.stations import station_room, upright_pose
from ladarreg_core.simulate.terrestrial import scan_around

_FINER = 3
"""Cells of a scan, and pixels of a photograph, in one that is simulated, each way: the rest are interpolated."""
_LOW, _TOP = np.radians(-60.0), np.radians(89.0)
_SCENE, _SEED = "office", 5
_ROOM_M = 1.2
"""Scanners and cameras stand so far from the middle of the room at most, each way."""
_PARTNERS = 4
"""Each photograph is tied to so many of the following ones."""
_COVARIANCE = np.diag([1e-4] * 3 + [2e-3] * 3) ** 2


def make_files(folder: Path, *, stations: int, cells: float, photos: int, size: tuple[int, int]) -> None:
    """Write scans, `station-01.npz` .., and photographs, `photo-001.jpg` .., with their poses into a folder."""
    room = station_room(_SCENE, _SEED)
    rng = np.random.default_rng(_SEED)
    rows = round((cells / 2) ** 0.5 / _FINER)
    coarse = SphericalGrid(rows, 2 * rows, np.pi / rows, (_TOP - _LOW) / (rows - 1), 0.0, _TOP)
    high, wide = _FINER * rows, 2 * _FINER * rows
    grid = SphericalGrid(high, wide, 2 * np.pi / wide, (_TOP - _LOW) / (high - 1), 0.0, _TOP)
    places = [
        upright_pose(rng.uniform(-_ROOM_M, _ROOM_M, 3) * [1, 1, 0.1], rng.uniform(-3, 3)) for _ in range(stations)
    ]
    for number, place in enumerate(places, 1):
        ranges, light = scan_around(*room, coarse, rng=rng, world_from_scanner=place)
        ranges, light = (cv2.resize(each, (wide, high), interpolation=cv2.INTER_NEAREST) for each in (ranges, light))
        ranges += rng.normal(0, 0.002, ranges.shape).astype(np.float32)
        write_npz_panorama(folder / f"station-{number:02d}.npz", Scan(grid, ranges, light))
    camera = Camera.from_focal(size[0] // _FINER, size[1] // _FINER, 0.8 * size[0] / _FINER)
    poses = []
    with ThreadPoolExecutor(2) as pool:
        for number in range(1, photos + 1):
            turn, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(-0.2, 0.15)
            centre = rng.uniform(-_ROOM_M, _ROOM_M, 3) * [1, 1, 0.2]
            poses.append(Rigid.from_centre(look_along([np.cos(turn), np.sin(turn), tilt]), centre))
            pixels = take_photograph(*room, camera, poses[-1], lighting=Lighting(), rng=rng)
            pool.submit(_write_photo, folder / f"photo-{number:03d}.jpg", pixels, size, number)
    np.savez(folder / "poses.npz", stations=[each.matrix for each in places], photos=[each.matrix for each in poses])


def _write_photo(
    path: Path, pixels: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], size: tuple[int, int], seed: int
) -> None:
    noise = np.random.default_rng(seed).integers(-4, 5, (size[1], size[0], 1), dtype=np.int16)
    fine = cv2.resize(pixels[..., ::-1], size, interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(path), np.clip(fine + noise, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])


def make_project(folder: Path, project: Path) -> None:
    """Make a project of the files of a folder, as an adjustment leaves it; each photograph is beside a station."""
    from ladarreg.workbench.given_files import Reading
    from ladarreg.workbench.launch import open_workbench

    known = np.load(folder / "poses.npz")
    scans, photos = sorted(folder.glob("station-*.npz")), sorted(folder.glob("photo-*.jpg"))
    places, poses = ([Rigid.from_matrix(each) for each in known[name]] for name in ("stations", "photos"))
    width, height = (int(each) for each in cv2.imread(str(photos[0])).shape[1::-1])
    camera = Camera.from_focal(width, height, 0.8 * width)
    sources = [Source(path=str(path), name=path.name, size=path.stat().st_size) for path in (*scans, *photos)]

    def edit(document: Document) -> Document:
        document = edits.with_scan(document, sources[0])
        document = with_stations(document, sources[1 : len(scans)]) if len(scans) > 1 else document
        ids = ["", *(station.id for station in document.stations)]
        known_photos = {}
        for number, (source, pose) in enumerate(zip(sources[len(scans) :], poses, strict=True)):
            beside = number % len(scans)
            document, name = edits.with_photo(document, source, CameraGiven(focal_px=camera.fx))
            entry = pose_entry("survey", _registration(pose @ places[beside], camera))
            document = edits.edited_photo(document, name, lambda p: edits.with_pose(p, entry))  # noqa: B023
            document = edits.edited_photo(document, name, lambda p: _beside(p, ids[beside]))  # noqa: B023
            known_photos[name] = AdjustedPhotoEntry(
                verdict="accepted", accepted=True, ties=100, median_px=0.4, camera="camera-1", pose=entry.name,
                sigma_m=0.002, sigma_rad=1e-4,
                partners=tuple(f"p{1 + (number + step) % len(poses)}" for step in range(1, _PARTNERS + 1)),
            )  # fmt: skip
        first = places[0].inverse
        adjusted = Adjusted(
            scans=tuple(
                AdjustedScanEntry(source=source, world_from_scanner=tuple(map(tuple, (first @ place).matrix.tolist())))
                for source, place in zip(sources, places, strict=False)
            ),
            photos=known_photos,
        )
        return replace(document, adjusted=adjusted)

    workbench = open_workbench((), project=project, reading=Reading(), solve_automatically=False)
    workbench.session.commit("Make a survey", edit, author=NOBODY)
    workbench.close()


def _beside(photo: PhotoEntry, station: str) -> PhotoEntry:
    return replace(photo, station=station)


def _registration(pose: Rigid, camera: Camera) -> Registration:
    described = describe_pose(
        pose, Matches.none(), np.zeros(0, np.bool_), camera, covariance=_COVARIANCE, sigma_px=1.0, sigma_range_m=0.01
    )
    fields = {name: getattr(described, name) for name in PoseResult.__dataclass_fields__}
    return Registration(**{**fields, "accepted": True, "evidence": "image"}, method="survey", options={}, seed=0)
