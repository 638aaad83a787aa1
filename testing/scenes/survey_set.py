"""A job as people hold it: stations in a room, photographs of two cameras, close-ups, and one of another room.

`python -m testing.scenes.survey_set` makes the sample survey of the package again.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.sample import sample_survey_folder
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose
from ladarreg_core.simulate.worlds.world import World
from ladarreg_core.survey.parts import RigMember, SurveyCamera, SurveyPhoto, SurveyScan
from ladarreg_core.survey.survey import Survey
from testing.scenes.kept import kept
from testing.scenes.photo_set import write_phone_photo

CAMERAS = (Camera.from_focal(960, 640, 780.0), Camera.from_focal(1152, 768, 1000.0))
"""The true cameras."""
_SAMPLE_SEED, _SAMPLE_SIZE = 12, 0.6
_FREE_M = 0.45  # around a camera
_STEP_M = 2.0**-9  # of the sample's coordinates, which so are compressed well
_STATIONS = (np.array([-0.9, -0.5, 0.0]), np.array([0.8, 0.7, 0.1]), np.array([1.2, -0.8, 0.0]))


@dataclass(frozen=True)
class TakenPhoto:
    """A photograph and the truth about it."""

    name: str
    pixels: ByteArray
    """(H, W, 3) uint8."""
    camera: int
    """Index of its camera."""
    camera_from_world: Rigid | None
    """Its true pose; None: it was taken elsewhere."""
    scale: float = 1.0
    """How many times larger it shows the surface than the other photographs."""


@dataclass(frozen=True)
class SurveySet:
    """Scans and photographs of one room."""

    scans: list[Scan]
    world_from_scanner: list[Rigid]
    """The true poses of the scanners; the first one's frame is the world of the survey only after `in_first`."""
    photos: list[TakenPhoto]
    cameras: list[Camera]
    focal_errors: tuple[float, ...] = field(default=())
    """Relative errors of the focal lengths that EXIF states, one a camera."""

    def in_first(self, camera_from_world: Rigid) -> Rigid:
        """Return a true pose relative to the first scanner."""
        return camera_from_world @ self.world_from_scanner[0]


@kept
def simulate_survey(
    scene: str = "office",
    *,
    seed: int = 3,
    stations: int = 2,
    photos: int = 12,
    close_ups: int = 0,
    close_scale: float = 3.0,
    step_deg: float = 0.2,
    strangers: int = 1,
    size: float = 1.0,
) -> SurveySet:
    """Simulate a survey; equal arguments give equal pixels.

    Args:
        scene: a scene of `SURROUNDINGS`.
        seed: of the room, the poses and the noise.
        stations: number of scans, up to three.
        photos: number of photographs, whose cameras alternate.
        close_ups: photographs after these, of surfaces that one of them shows.
        close_scale: how many times larger they show them.
        step_deg: angle between neighbouring rays of the scans.
        strangers: photographs of another room at the end.
        size: of the photographs, relative to `CAMERAS`.
    """
    rng = np.random.default_rng([seed, 411])
    room = station_room(scene, seed)
    poses, errors, cameras = _drawn(rng, stations, size)
    scans = scan_stations(room, poses, seed=seed, step_deg=step_deg)
    taken = []
    for k in range(photos):
        where = _standpoint(room, rng)
        taken.append(_taken(room, f"IMG_{k + 1:04}.jpg", k % 2, cameras, where, rng))
    for k in range(close_ups):
        where = _close_up(room, cameras[0], taken[k % photos], close_scale, rng)
        taken.append(_taken(room, f"close_{k + 1:02}.jpg", 0, cameras, where, rng, scale=close_scale))
    other = station_room(scene, seed + 500) if strangers else room
    for k in range(strangers):
        one = _taken(other, f"elsewhere_{k + 1}.jpg", k % 2, cameras, _standpoint(other, rng), rng)
        taken.append(replace(one, camera_from_world=None))
    return SurveySet(scans, poses, taken, cameras, errors)


def sample_cameras() -> list[Camera]:
    """Return the true cameras of the sample survey, whose photographs alternate between them."""
    rng = np.random.default_rng([_SAMPLE_SEED, 411])
    return _drawn(rng, 2, _SAMPLE_SIZE)[2]


def _drawn(rng: np.random.Generator, stations: int, size: float) -> tuple[list[Rigid], tuple[float, ...], list[Camera]]:
    """Return where the scanners stand, the relative errors of the focal lengths that EXIF states, and the cameras."""
    poses = [upright_pose(place, float(rng.uniform(-np.pi, np.pi))) for place in _STATIONS[:stations]]
    errors = tuple(float(rng.choice((-1, 1)) * rng.uniform(0.01, 0.03)) for _ in CAMERAS)
    cameras = [
        replace(camera, cx=camera.cx + dx, cy=camera.cy + dy, distortion=(float(rng.normal(0, 0.02)), 0.0, 0.0, 0.0))
        for camera, (dx, dy) in zip(
            [Camera.from_focal(round(size * one.width), round(size * one.height), size * one.fx) for one in CAMERAS],
            rng.normal(0, 0.004 * CAMERAS[0].width * size, (len(CAMERAS), 2)), strict=True,
        )
    ]  # fmt: skip
    return poses, errors, cameras


def simulate_rig_survey(
    *, frames: int, dark: Collection[tuple[str, str]] = (), seed: int = 8
) -> tuple[Survey, dict[str, Rigid]]:
    """Simulate a head with two cameras, unlike each other, at some places of a room, beside one scan of it.

    Args:
        frames: number of places.
        dark: photographs in which nothing is seen, by frame and sensor.
        seed: of the room, the places and the noise.

    Returns:
        The survey, whose rig is `head` with the sensors `left` and `right`, and the true poses by the photographs' ids.
    """
    rng = np.random.default_rng([seed, 412])
    room = station_room("office", seed)
    stands = upright_pose(_STATIONS[0], float(rng.uniform(-np.pi, np.pi)))
    (scan,) = scan_stations(room, [stands], seed=seed, step_deg=0.2)
    right_from_left = Rigid.from_rotvec([0.0, -0.5, 0.02], [-0.25, 0.01, 0.04])
    photos, truth = [], {}
    for frame in range(frames):
        left = _standpoint(room, rng)
        for sensor, pose, camera in (("left", left, CAMERAS[0]), ("right", right_from_left @ left, CAMERAS[1])):
            name = f"{sensor}-{frame}"
            pixels = take_photograph(*room, camera, pose, lighting=Lighting(), rng=rng)
            if (str(frame), sensor) in dark:
                pixels = np.full_like(pixels, 8)
            truth[name] = pose @ stands
            photo = Photo(pixels=pixels, camera=camera, name=name, calibrated=True)
            member = RigMember(id="head", frame=str(frame), sensor=sensor)
            photos.append(SurveyPhoto(id=name, source=photo, camera=sensor, rig=member))
    survey = Survey(
        scans=(SurveyScan(id="scan", source=scan),),
        cameras=(SurveyCamera(id="left", estimate="none"), SurveyCamera(id="right", estimate="none")),
        photos=tuple(photos), rigs={"head": {"left": None, "right": None}},
    )  # fmt: skip
    return survey, truth


def write_survey_set(folder: Path, found: SurveySet) -> None:
    """Write scans and photographs into a folder, as an operator has them."""
    for k, scan in enumerate(found.scans):
        write_npz_xyz(folder / f"station{k + 1}.npz", scan)
    for one in found.photos:
        error = found.focal_errors[one.camera]
        write_phone_photo(
            folder / one.name, one.pixels, found.cameras[one.camera], focal_error=error, model=f"P{one.camera + 1}"
        )


def write_sample_survey(folder: Path) -> None:
    """Write the sample survey of the package, and what is true of it, into a folder."""
    found = simulate_survey("office", photos=8, close_ups=1, step_deg=0.3, seed=_SAMPLE_SEED, size=_SAMPLE_SIZE)
    write_survey_set(folder, found)
    for k, scan in enumerate(found.scans):
        xyz = (np.round(scan.points / _STEP_M) * _STEP_M).astype(np.float32)
        brightness = np.rint(255 * np.clip(scan.intensity / np.nanmax(scan.intensity), 0, 1)).astype(np.uint8)
        np.savez_compressed(
            folder / f"station{k + 1}.npz", xyz=xyz, intensity=brightness, intensity_is=scan.intensity_is
        )
    truth = {
        "made_by": "python -m testing.scenes.survey_set",
        "world_is": "the frame of station1",
        "world_from_scanner": {
            f"station{k + 1}": (found.world_from_scanner[0].inverse @ pose).matrix.tolist()
            for k, pose in enumerate(found.world_from_scanner)
        },
        "camera_from_world": {
            Path(one.name).stem: None
            if one.camera_from_world is None
            else found.in_first(one.camera_from_world).matrix.tolist()
            for one in found.photos
        },
        "focal_px": [camera.fx for camera in found.cameras],
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")


def _standpoint(room: tuple[World, RayCaster], rng: np.random.Generator) -> Rigid:
    """Return a pose in the room, looking at something at least 1.5 m away."""
    while True:
        centre = np.array([*rng.uniform(-1.6, 1.6, 2), rng.uniform(-0.2, 0.3)])
        around = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)])
        if np.min(_distances(room, centre, around)) < _FREE_M:
            continue
        yaw, pitch, roll = rng.uniform(-np.pi, np.pi), rng.normal(0, 0.06), rng.normal(0, 0.03)
        ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        if not np.min(_distances(room, centre, ahead[None])) > 1.5:
            continue
        return Rigid.from_centre(Rigid.from_rotvec([0, 0, roll]).rotation @ look_along(ahead), centre)


def _close_up(
    room: tuple[World, RayCaster], camera: Camera, seen: TakenPhoto, scale: float, rng: np.random.Generator
) -> Rigid:
    """Return a pose near a surface that a photograph shows."""
    assert seen.camera_from_world is not None
    world_from_camera = seen.camera_from_world.inverse
    while True:
        at = camera.unproject(
            np.array([[rng.uniform(0.25, 0.75) * camera.width, rng.uniform(0.3, 0.7) * camera.height]])
        )
        ray = (world_from_camera.rotation @ at[0]) / np.linalg.norm(at[0])
        distance = float(_distances(room, seen.camera_from_world.centre, ray[None])[0])
        if not np.isfinite(distance) or distance < 1.2:
            continue
        target = seen.camera_from_world.centre + distance * ray
        side = rng.normal(0, 0.12, 3)
        toward = ray + side - (side @ ray) * ray
        toward /= np.linalg.norm(toward)
        centre = target - distance / scale * toward
        if float(_distances(room, centre, toward[None])[0]) < 0.8 * distance / scale:
            continue
        roll = float(rng.normal(0, 0.05))
        return Rigid.from_centre(Rigid.from_rotvec([0, 0, roll]).rotation @ look_along(toward), centre)


def _distances(room: tuple[World, RayCaster], origin: FloatArray, rays: FloatArray) -> FloatArray:
    """Return how far (N,) unit rays (N, 3) reach; infinite where they meet nothing."""
    world, caster = room
    face = caster.first_hit(origin, rays)
    a, b, c = np.moveaxis(world.triangles[np.maximum(face, 0)].astype(np.float64), 1, 0)
    normal = np.cross(b - a, c - a)
    reach = np.einsum("ni,ni->n", a - origin, normal) / np.einsum("ni,ni->n", rays, normal)
    return np.where(face >= 0, reach, np.inf)


def _taken(
    room: tuple[World, RayCaster], name: str, camera: int, cameras: list[Camera], pose: Rigid,
    rng: np.random.Generator, scale: float = 1.0,
) -> TakenPhoto:  # fmt: skip
    pixels = take_photograph(*room, cameras[camera], pose, lighting=Lighting(), rng=rng)
    return TakenPhoto(name, pixels, camera, pose, scale)


if __name__ == "__main__":
    write_sample_survey(sample_survey_folder())
