"""A small room with painted walls and two boxes, seen by a scanner and by a camera: exact truth, generated quickly.

It needs no ray caster: everything is a plane or an axis-parallel box, met in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec, rotvec_from_rotation
from ladarreg_core.photo import Photo
from ladarreg_core.registration.register import register
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.remap import look_up
from testing.scenes.kept import kept

BOXES = [  # lower and upper corner, m
    ((4.5, -3.0, -1.2), (4.8, 3.0, 2.0)),  # the wall
    ((0.5, -3.0, -1.4), (4.8, 3.0, -1.2)),  # the floor
    ((2.8, 0.2, -1.2), (3.4, 0.9, -0.1)),
    ((2.3, -0.8, -1.2), (2.9, -0.2, -0.5)),
    ((3.2, -1.3, 0.1), (3.6, -0.7, 0.6)),
]


@dataclass(frozen=True)
class PaintedRoom:
    scan: Scan
    photo: Photo
    camera_from_scanner: Rigid

    def error_px(self, pose: Rigid) -> float:
        """Median displacement of the scan's visible cells in the photo."""
        points = self.scan.points[self.scan.valid][::23].astype(float)
        camera = self.photo.camera
        true = camera.project(self.camera_from_scanner @ points)
        seen = camera.contains(true)
        return float(np.median(np.hypot(*(true - camera.project(pose @ points))[seen].T)))

    def mahalanobis(self, pose: Rigid, covariance: np.ndarray) -> float:
        """Error in standard deviations, per parameter."""
        w = rotvec_from_rotation(self.camera_from_scanner.rotation @ pose.rotation.T)
        d = np.concatenate([w, self.camera_from_scanner.centre - pose.centre])
        return float(np.sqrt(d @ np.linalg.inv(covariance) @ d / 6))


def paintings(seed: int) -> np.ndarray:
    """One picture for all faces: patches, bars and dots, (1024, 1024, 3) float32, 0 to 1."""
    rng = np.random.default_rng(seed)
    image = np.full((1024, 1024, 3), 0.55, np.float32)
    for _ in range(450):
        color = tuple(map(float, rng.uniform(0.1, 0.95, 3)))
        u, v = map(int, rng.integers(0, 1024, 2))
        if rng.random() < 0.6:
            corner = (u + int(rng.integers(15, 110)), v + int(rng.integers(15, 110)))
            cv2.rectangle(image, (u, v), corner, color, -1, cv2.LINE_AA)
        elif rng.random() < 0.5:
            cv2.circle(image, (u, v), int(rng.integers(6, 45)), color, -1, cv2.LINE_AA)
        else:
            end = (u + int(rng.integers(-150, 150)), v + int(rng.integers(-150, 150)))
            cv2.line(image, (u, v), end, color, int(rng.integers(2, 9)), cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def shoot(
    origin: np.ndarray, rays: np.ndarray, boxes: list[tuple[tuple[float, ...], tuple[float, ...]]] = BOXES
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, the box that each ray (N, 3) meets first (-1: none) and the face's axis."""
    best = np.full(len(rays), np.inf)
    box, axis = np.full(len(rays), -1), np.zeros(len(rays), int)
    for number, (low, high) in enumerate(boxes):
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = [(np.array(edge) - origin) / rays for edge in (low, high)]
        near, far = np.minimum(*ends), np.maximum(*ends)
        # Column by column: numpy reduces along a short last axis ten times slower.
        enter = np.maximum(np.maximum(near[:, 0], near[:, 1]), near[:, 2])
        leave = np.minimum(np.minimum(far[:, 0], far[:, 1]), far[:, 2])
        hit = np.flatnonzero((enter < leave) & (enter > 0.05) & (enter < best))
        best[hit], box[hit], axis[hit] = enter[hit], number, near[hit].argmax(axis=1)
    return best, box, axis


def paint(points: np.ndarray, box: np.ndarray, axis: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Return the colour (N, 3) of points on the boxes' faces."""
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    flat = np.take_along_axis(points, others, axis=1) * 190 + (box * 211 + axis * 137)[:, None]
    uv = np.mod(flat, 1023).astype(np.float32)
    return look_up(picture, uv[:, :1], uv[:, 1:])[:, 0]


@kept
def painted_room(seed: int = 0, *, distortion: tuple[float, ...] = (), baseline_m: float = 0.4) -> PaintedRoom:
    """Make the room: a scan of 420 x 300 cells and a photo of 480 x 340 pixels at `baseline_m` to the side."""
    rng = np.random.default_rng(seed)
    picture = paintings(seed)
    geometry = AzimuthElevation(300, 420, np.deg2rad(0.11), np.deg2rad(0.11))
    rays = geometry.rays.reshape(-1, 3)
    ranges, box, axis = shoot(np.zeros(3), rays)
    ranges = np.where(box >= 0, ranges, np.nan)
    color = paint(rays * np.nan_to_num(ranges, nan=1)[:, None], box, axis, picture)
    laser = (0.7 * color[:, 0] + 0.3 * color[:, 1]) * (2.5 / np.nan_to_num(ranges, nan=9)) ** 2
    laser = laser * (1 + rng.normal(0, 0.05, len(laser)))
    ranges = ranges + rng.normal(0, 0.003, len(ranges))
    scan = Scan(geometry, ranges.reshape(300, 420), laser.reshape(300, 420))

    centre = np.array([0.05, rng.choice([-1, 1]) * baseline_m, 0.08])
    turn = rotation_from_rotvec(np.deg2rad(rng.uniform(-2, 2, 3)))
    pose = Rigid.from_centre(turn @ look_along(np.array([3.5, 0.0, -0.2]) - centre), centre)
    camera = Camera(480, 340, 520.0, 520.0, 239.5, 169.5, distortion)
    fine = 3  # samples a pixel each way
    v, u = np.mgrid[: 340 * fine, : 480 * fine]
    uv = (np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5) / fine - 0.5
    seen = camera.unproject(uv) @ pose.rotation
    distance, box, axis = shoot(centre, seen)
    sky = box < 0
    color = paint(centre + seen * np.where(sky, 1, distance)[:, None], box, axis, picture)
    color[sky] = 0.8
    color = cv2.resize(color.reshape(340 * fine, 480 * fine, 3), (480, 340), interpolation=cv2.INTER_AREA)
    color = 255 * np.clip(color + rng.normal(0, 0.01, color.shape), 0, 1) ** (1 / 2.2)
    return PaintedRoom(scan, Photo(color.astype(np.uint8), camera), pose)


@kept
def registered_room(seed: int = 0) -> Registration:
    """Return the registration of the room of a seed, from nothing and with all options as they are."""
    room = painted_room(seed)
    return register(replace(room.scan), room.photo)
