"""A painted room photographed from many places, with known exposures, and things that stand elsewhere each time."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.export.targets.folder import export_registration
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.foundations.linear_light import encoded_codes, linear_light
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture.best_photo import PosedPhoto
from testing.scenes.kept import kept
from testing.scenes.painted_room import BOXES, paint, paintings, shoot
from testing.scenes.small_registration import sample_registration

SIGMA_RAD, SIGMA_M = 4e-4, 1e-3
"""Standard deviations of the poses, of each axis."""
_OUTSIDE = 0.35
_AIM = np.array([3.8, 0.0, -0.2])


@dataclass(frozen=True)
class PhotoTour:
    """The room's scan, its photographs and the truth about them."""

    scan: Scan
    truth: np.ndarray
    """(H, W, 3) the colour of each cell in linear light, 0 to 1; NaN without a return."""
    views: tuple[PosedPhoto, ...]
    """The photographs with poses that err by their covariance."""
    gains: np.ndarray
    """(K, 3) gains that undo their exposures, of geometric mean 1."""
    moved: tuple[np.ndarray, ...]
    """For each photograph (h, w) bool: the pixels that show one of the moved things."""

    def shows_moved(self, photo: np.ndarray) -> np.ndarray:
        """Return which cells (H, W) show a moved thing if each has the colour of photograph `photo` (H, W)."""
        found = np.zeros(photo.shape, np.bool_)
        for k, (view, mask) in enumerate(zip(self.views, self.moved, strict=True)):
            rows, columns = np.nonzero(photo == k)
            uv = view.camera.project(view.camera_from_scanner @ self.scan.points[rows, columns].astype(np.float64))
            column, row = np.clip(np.rint(uv), 0, np.array(view.camera.size) - 1).astype(int).T
            found[rows, columns] = mask[row, column]
        return found


@kept
def photo_tour(
    seed: int = 0,
    *,
    photos: int = 6,
    moved: int = 0,
    exposure: float = 0.2,
    cells: tuple[int, int] = (240, 336),
    size: tuple[int, int] = (400, 280),
    reach_m: float = 1.3,
    vignetting: tuple[float, float] = (0.0, 0.0),
) -> PhotoTour:
    """Make the room, its scan and photographs from either side of the scanner.

    Args:
        seed: of the paint, the poses and the noise.
        photos: number of photographs.
        moved: number of things, of which each photograph shows most, each time in another place.
        exposure: standard deviation of the logarithms of the exposures, and half as much between the channels.
        cells: rows and columns of the scan.
        size: of the photographs, px.
        reach_m: how far from the scanner they are taken.
        vignetting: a and b of the light exp(a r^2 + b r^4) of every photograph, r = 1 at its corners.
    """
    rng = np.random.default_rng([seed, 2026])
    picture, other = paintings(seed), 1 - paintings(seed + 1000)
    scan, truth = scan_of_tour(seed, cells=cells)
    gains = np.exp(rng.normal(0, exposure, (photos, 1)) + rng.normal(0, exposure / 2, (photos, 3)))
    gains /= np.exp(np.log(gains).mean(axis=0))
    views, masks = [], []
    for k in range(photos):
        centre = np.array([rng.uniform(-0.2, 0.6), rng.uniform(-reach_m, reach_m), rng.uniform(-0.4, 0.5)])
        aim = _AIM + rng.normal(0, (0.1, 0.7, 0.25))
        pose = Rigid.from_centre(rotation_from_rotvec(rng.normal(0, 0.03, 3)) @ look_along(aim - centre), centre)
        camera = Camera.from_focal(*size, float(size[0] * rng.uniform(0.95, 1.5)))
        things = [_thing(rng) for _ in range(moved) if rng.random() < 0.8]
        light, mask = _photograph(camera, pose, picture, other, things)
        exposed = light * _falloff(size, vignetting)[..., None] / gains[k] + rng.normal(0, 0.004, light.shape)
        pixels = np.rint(encoded_codes(np.clip(exposed, 0, 1))).astype(np.uint8)
        shift = rng.normal(0, 1, 6) * np.repeat([SIGMA_RAD, SIGMA_M], 3)
        found = Rigid.from_centre(rotation_from_rotvec(shift[:3]) @ pose.rotation, pose.centre + shift[3:])
        covariance = np.diag(np.repeat([SIGMA_RAD**2, SIGMA_M**2], 3))
        views.append(PosedPhoto(Photo(pixels, camera, name=f"IMG_{k + 1:04}.jpg"), found, camera, covariance))
        masks.append(mask)
    return PhotoTour(scan, truth, tuple(views), gains, tuple(masks))


def _falloff(size: tuple[int, int], vignetting: tuple[float, float]) -> np.ndarray:
    """Return the share of light (h, w) that the lens leaves in a photograph."""
    u, v = (2 * np.arange(n) - n + 1 for n in size)
    squared = (np.square(v)[:, None] + np.square(u)) / (size[0] ** 2 + size[1] ** 2)
    return np.exp(vignetting[0] * squared + vignetting[1] * squared**2)


def scan_of_tour(
    seed: int = 0, *, cells: tuple[int, int] = (240, 336), at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[Scan, np.ndarray]:
    """Return a scan of the room from a place, with its pose, and the colour of each cell (H, W, 3) in linear light."""
    rng, place = np.random.default_rng([seed, 2027]), np.array(at_m)
    step = np.deg2rad(33) / cells[0]
    geometry = AzimuthElevation(*cells, step, step)
    rays = geometry.rays.reshape(-1, 3)
    ranges, box, axis = shoot(place, rays)
    met = box >= 0
    color = paint(place + rays * np.where(met, ranges, 1)[:, None], box, axis, paintings(seed))
    truth = np.where(met[:, None], color, np.nan).reshape(*cells, 3)
    noisy = np.where(met, ranges, np.nan) + rng.normal(0, 0.003, len(ranges))
    laser = np.nan_to_num(0.7 * truth[..., 0] + 0.3 * truth[..., 1], nan=0.1)
    pose = Rigid(np.eye(3), place)
    return Scan(geometry, noisy.reshape(cells), laser, world_from_scanner=pose, name="room"), truth


def write_tour(
    folder: Path, tour: PhotoTour, *, given: tuple[int, ...] = (), name: str = "scan", first: int = 0
) -> list[Path]:
    """Write the scan, the photographs from the n-th on and a folder of results for each, and return these folders.

    Args:
        folder: an existing folder.
        tour: what is written; its poses are relative to the scanner.
        given: numbers of photographs whose pose is given, not accepted.
        name: of the scan's file.
        first: number of the first photograph.
    """
    write_npz_xyz(folder / f"{name}.npz", tour.scan)
    scan = replace(read_scan(folder / f"{name}.npz"), world_from_scanner=tour.scan.world_from_scanner)
    found = []
    for k, view in enumerate(tour.views[first:], first):
        assert view.covariance is not None
        picture, camera = folder / Path(view.photo.name).with_suffix(".png"), folder / f"camera-{k}.json"
        cv2.imwrite(str(picture), view.photo.pixels[..., ::-1])
        camera.write_text(json.dumps(view.camera.as_fields()))
        photo = read_photo(picture, camera=camera)
        registration = replace(
            sample_registration(), camera_from_scanner=view.camera_from_scanner, camera=view.camera,
            covariance=np.asarray(view.covariance), world_from_scanner=scan.world_from_scanner,
            method="survey",
        )  # fmt: skip
        if k in given:
            registration = replace(registration, accepted=False, evidence="given", reasons=("given",))
        export_registration(folder / f"results-{k}", registration, scan, photo)
        found.append(folder / f"results-{k}")
    return found


def _thing(rng: np.random.Generator) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return a box that stands before the wall."""
    low = np.array([rng.uniform(1.9, 3.6), rng.uniform(-1.6, 1.6), -1.2])
    return tuple(low), tuple(low + np.array([0.3, rng.uniform(0.25, 0.5), rng.uniform(0.7, 1.7)]))


def _photograph(
    camera: Camera, pose: Rigid, picture: np.ndarray, other: np.ndarray, things: list[tuple[tuple[float, ...], ...]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a photograph (h, w, 3) in linear light, and the pixels (h, w) that show things."""
    fine = 2
    v, u = np.mgrid[: camera.height * fine, : camera.width * fine]
    uv = (np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5) / fine - 0.5
    seen = camera.unproject(uv) @ pose.rotation
    distance, box, axis = shoot(pose.centre, seen, [*BOXES, *things])  # type: ignore[list-item]
    points = pose.centre + seen * np.where(box < 0, 1, distance)[:, None]
    is_thing = box >= len(BOXES)
    color = np.full((len(seen), 3), _OUTSIDE)
    for pixels, paper in (((box >= 0) & ~is_thing, picture), (is_thing, other)):
        if pixels.any():
            color[pixels] = paint(points[pixels], box[pixels], axis[pixels], paper)
    shape = camera.height * fine, camera.width * fine
    small = cv2.resize(color.reshape(*shape, 3), camera.size, interpolation=cv2.INTER_AREA)
    mask = cv2.resize(is_thing.reshape(shape).astype(np.float32), camera.size, interpolation=cv2.INTER_AREA) > 0.3
    return small, mask


def light_error(image: np.ndarray, truth: np.ndarray, cells: np.ndarray) -> float:
    """Return the median error of colours (H, W, 3) in sRGB codes against linear light, over cells (H, W).

    One gain a channel, which no photograph determines, is fitted.
    """
    light = linear_light(image[cells])
    gain = np.median(truth[cells] / np.maximum(light, 1e-3), axis=0)
    return float(np.median(np.abs(encoded_codes(light * gain) - encoded_codes(truth[cells])).max(axis=-1)))
