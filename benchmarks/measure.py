"""Measurements against the truth: whether 95 % intervals contain it, and whether points at depth edges are flagged.

    python -m benchmarks.measure [--rooms 20] [--draws 50] [--real 12] [--first-seed 500]
    python -m benchmarks.measure --figure docs/pictures/rectified.png

In each simulated room one photograph is registered, and its covariance taken. Each draw then puts the pose and the
uncertain intrinsics off by a draw from it, gives every range fresh noise and every picked pixel half a pixel of error,
and measures between ten points of the photograph and ten of the scan. `--real` registers that many further rooms and
measures at the poses that were found. Intervals are clustered by room: the standard error is that of the rooms' shares.

Depth edges are those of the true surfaces: neighbouring pixels on faces whose planes are more than 4 % of the depth
apart there, whichever of them is extended. Points are picked within a pixel of one.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import ladarreg_core as lr
from benchmarks.shared.bars import Row, table
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.inspection.measuring.measurement import KINDS, Measurement, measure
from ladarreg_core.inspection.measuring.points import AT_EDGE, MeasuredPoints
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate.case import SimulatedCase, case_world, simulate_case
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.terrestrial import RangeNoise, scan_around
from ladarreg_core.simulate.worlds.world import World

SCENES = ("office", "boxes", "desk", "people")
POINTS = 10
CLICK_PX = 0.5
EDGE_FRACTION = 0.04
GRID = AzimuthElevation(rows=350, columns=500, d_azimuth_rad=np.radians(0.11), d_elevation_rad=np.radians(0.11))
NOISE = RangeNoise(sigma_m=0.004)
_EXACT = RangeNoise(sigma_m=0.0, resolution_m=1e-6, speckle=1e-3)
_BEAM_RAD = 5e-4


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A room with what was truly there."""

    case: SimulatedCase
    world: World
    caster: RayCaster
    amplitude: NDArray[np.float32]
    ranges: NDArray[np.float32]
    beside: NDArray[np.float32]
    """The ranges half a beam aside, with which those at edges mix."""
    edges: NDArray[np.bool_]
    """Pixels of the photograph within one of a depth edge."""
    inside: NDArray[np.bool_]
    """Pixels 20 px from every depth edge and from everything that the scanner does not see."""

    @staticmethod
    def of(scene: str, seed: int) -> Room:
        case, world = simulate_case(scene, seed=seed), case_world(scene, seed=seed)
        caster, rng = RayCaster(world.triangles), np.random.default_rng(0)
        ranges, amplitude = scan_around(world, caster, GRID, rng=rng, noise=_EXACT)
        aside = Rigid.from_rotvec((0, 0, _BEAM_RAD))
        beside, _ = scan_around(world, caster, GRID, rng=rng, noise=_EXACT, world_from_scanner=aside)
        edges, hidden = _edges_and_hidden(world, caster, case.true_camera, case.camera_from_scanner)
        inside = cv2.dilate((edges | hidden).astype(np.uint8), np.ones((41, 41), np.uint8)) == 0
        return Room(case, world, caster, amplitude, ranges, beside, edges, inside)

    def scan(self, rng: np.random.Generator) -> Scan:
        """Return a scan with fresh noise, its ranges mixed at edges."""
        share = rng.uniform(0, 1, self.ranges.shape).astype(np.float32)
        apart = np.abs(self.beside - self.ranges) > 0.03 * self.ranges
        mixed = np.where(apart, share * self.ranges + (1 - share) * self.beside, self.ranges).astype(np.float32)
        ranges, intensity = NOISE.measured(self.amplitude, mixed, rng)
        return Scan(GRID, ranges, intensity)

    def truth(self, rays: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the true point (N, 3) that each ray (N, 3), scanner frame, meets first; NaN: none."""
        faces, depth = _met(self.world, self.caster, rays, origin)
        return np.where((faces > 0)[:, None], origin + depth[:, None] * rays, np.nan)


def _met(
    world: World, caster: RayCaster, rays: NDArray[np.float64], origin: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    triangle = caster.first_hit(origin, rays)
    faces = np.where(triangle < 0, 0, np.take(world.face_of_triangle, triangle)).astype(np.int32)
    return faces, _depth_on(world, faces, rays, origin)


def _depth_on(
    world: World, faces: NDArray[np.int32], rays: NDArray[np.float64], origin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return where rays meet the planes of faces, which may be others than those that they hit."""
    normals = world.normals[:, faces].T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((world.offsets_m[faces] - normals @ origin) / (normals * rays).sum(axis=1))


def _edges_and_hidden(
    world: World, caster: RayCaster, camera: Camera, pose: Rigid
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the pixels (H, W) within one of a depth edge, and those that show what the scanner does not see."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.stack([u, v], axis=-1).astype(float)).reshape(-1, 3) @ pose.rotation
    faces, depth = _met(world, caster, rays, pose.centre)
    shape = (camera.height, camera.width)
    number = np.arange(faces.size).reshape(shape)
    found = np.zeros(shape, np.bool_)
    for here, there in ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:])):
        a, b = here.ravel(), there.ravel()
        differ = np.flatnonzero(faces[a] != faces[b])
        a, b = a[differ], b[differ]
        apart = np.ones(len(a), np.bool_)
        for one, other in ((a, b), (b, a)):
            extended = _depth_on(world, faces[one], rays[other], pose.centre)
            apart &= ~(np.abs(extended - depth[other]) <= EDGE_FRACTION * np.minimum(depth[one], depth[other]))
        for side in (a[apart], b[apart]):
            found.reshape(-1)[side] = True
    points = pose.centre + depth[:, None] * rays
    cell = np.asarray(GRID.cell_of(points), np.float64)
    seen = caster.sees(points - 0.003 * rays, np.zeros(3)) & (cell >= 2).all(axis=1)
    seen &= (cell <= np.array(GRID.shape) - 3).all(axis=1) & (faces > 0)
    near = cv2.dilate(found.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)
    return near, ~seen.reshape(shape)


def drawn(result: PoseResult, pose: Rigid, camera: Camera, rng: np.random.Generator) -> PoseResult:
    """Return a result whose pose and intrinsics are off the true ones by a draw from its covariance."""
    joint = result.camera_uncertainty
    covariance = result.covariance if joint is None else joint.covariance
    off = rng.multivariate_normal(np.zeros(len(covariance)), covariance, method="eigh")
    turned = rotation_from_rotvec(-off[:3]) @ pose.rotation
    changed = camera
    for name, change in zip(() if joint is None else joint.names, off[6:], strict=True):
        if name == "focal_px":
            scale = 1 - change / camera.focal_px
            changed = replace(changed, fx=changed.fx * scale, fy=changed.fy * scale)
        elif name == "k1":
            changed = replace(changed, distortion=(changed.distortion[0] - change, *changed.distortion[1:]))
        else:
            changed = replace(changed, **{name: getattr(changed, name) - change})
    return replace(result, camera_from_scanner=Rigid.from_centre(turned, pose.centre - off[3:6]), camera=changed)


def measured(
    room: Room, scan: Scan, result: PoseResult, rng: np.random.Generator
) -> Iterator[tuple[str, Measurement, Measurement]]:
    """Yield measurements between ten points of the photograph, and of the scan, beside the true ones."""
    camera, pose = room.case.true_camera, room.case.camera_from_scanner
    uv = rng.uniform((5, 5), (camera.width - 6, camera.height - 6), (POINTS, 2))
    truth = room.truth(camera.unproject(uv) @ pose.rotation, pose.centre)
    yield from _sets("photo", truth, MeasuredPoints.of_photo(scan, result, uv + rng.normal(0, CLICK_PX, uv.shape)))
    cells = rng.uniform((3, 3), np.array(GRID.shape) - 4, (POINTS, 2))
    truth = room.truth(np.asarray(GRID.ray_at(cells), np.float64), np.zeros(3))
    clicked = cells + rng.normal(0, CLICK_PX, cells.shape)
    yield from _sets("scan", truth, MeasuredPoints.of_scan(scan, cells=clicked))


def _sets(
    where: str, truth: NDArray[np.float64], found: MeasuredPoints
) -> Iterator[tuple[str, Measurement, Measurement]]:
    known = np.isfinite(truth).all(axis=1)
    good = [k for k in range(len(found)) if known[k] and not found.flags[k] and not found.refusals[k]]
    for kind, number in zip(KINDS, (1, 2, 4, 3, 4, 4), strict=True):
        for first in range(0, len(good) - number + 1, number):
            rows = good[first : first + number]
            try:
                exact = measure(kind, MeasuredPoints.given(truth[rows]))
                estimated = measure(kind, found.subset(rows))
            except lr.LadarregError:  # such as sides of an area that cross
                continue
            yield f"{where} {kind}", estimated, exact


def at_edges(scan: Scan, result: PoseResult, rng: np.random.Generator, mask: NDArray[np.bool_]) -> float:
    """Return the share of points in a mask (H, W) of the photograph that are flagged as at an edge, or refused."""
    v, u = rng.permutation(np.argwhere(mask))[:POINTS].T
    if not len(u):
        return float("nan")
    found = MeasuredPoints.of_photo(scan, result, np.stack([u, v], axis=1) + rng.uniform(-0.5, 0.5, (len(u), 2)))
    return float(
        np.mean([AT_EDGE in flags or bool(why) for flags, why in zip(found.flags, found.refusals, strict=True)])
    )


def clustered(by_room: dict[int, list[bool]]) -> tuple[float, float, int]:
    """Return the share that is covered, its standard error over rooms, and the number of measurements."""
    total = sum(map(len, by_room.values()))
    share = sum(map(sum, by_room.values())) / total
    off = np.array([sum(one) - share * len(one) for one in by_room.values()])
    count = len(off)
    return share, float(np.sqrt((off**2).sum() * count / max(count - 1, 1)) / total), total


def figure(path: Path) -> None:
    """Write a picture of the sample's photograph, of its wall rectified, and of the error of each pixel."""
    from ladarreg_core.simulate.sample import sample_folder

    scan = lr.read_scan(sample_folder() / "scan.npz")
    photo = lr.read_photo(sample_folder() / "photo.png", camera=sample_folder() / "camera.json")
    result = lr.register(scan, photo)
    wall = lr.Plane.fitted(scan, MeasuredPoints.of_photo(scan, result, [[560, 170]]).xyz[0])
    source = lr.RegisteredScan(scan, [lr.RegisteredPhoto("photo", photo, result)])
    view = lr.rectify(source, wall, mm_per_pixel=4)
    rows, columns = (np.flatnonzero(view.known.any(axis=k)) for k in (1, 0))
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    shown = np.where(view.known[..., None], view.image, 128)[part].astype(np.uint8)
    mm = np.nan_to_num(1000 * view.sigma_m[part])
    top = float(np.percentile(mm[mm > 0], 98))
    error = cv2.applyColorMap(np.clip(255 * mm / top, 0, 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    error[~view.known[part]] = 128
    cv2.putText(error, f"0 to {top:.1f} mm", (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
    height = 400
    strips = [cv2.resize(one, (round(one.shape[1] * height / one.shape[0]), height), interpolation=cv2.INTER_AREA)
              for one in (photo.pixels, shown, error)]  # fmt: skip
    cv2.imwrite(str(path), np.concatenate(strips, axis=1)[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rooms", type=int, default=20)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--real", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=500)
    parser.add_argument("--figure", type=Path)
    asked = parser.parse_args()
    if asked.figure is not None:
        figure(asked.figure)
        return
    started = time.process_time()
    covered: dict[str, dict[int, list[bool]]] = defaultdict(lambda: defaultdict(list))
    edge, inside = defaultdict(list), defaultdict(list)
    draws = 0
    for number in range(asked.rooms + asked.real):
        seed, real = asked.first_seed + number, number >= asked.rooms
        room = Room.of(SCENES[number % len(SCENES)], seed)
        rng = np.random.default_rng([seed, 7])
        result = lr.register(room.scan(rng) if real else room.case.scan, room.case.photo)
        if not result.accepted:
            print(f"room {seed}: not accepted, left out", flush=True)
            continue
        for draw in range(1 if real else asked.draws):
            scan = room.scan(np.random.default_rng([seed, 7])) if real else room.scan(rng)
            one = result if real else drawn(result, room.case.camera_from_scanner, room.case.true_camera, rng)
            draws += not real
            for kind, estimated, exact in measured(room, scan, one, rng):
                low, high = np.asarray(estimated.interval)
                hits = np.atleast_1d((low <= exact.value) & (exact.value <= high))
                covered[f"real {kind}" if real else kind][seed] += hits.tolist()
                covered["real, all" if real else "all"][seed] += hits.tolist()
            if draw % 5 == 0:
                edge[seed].append(at_edges(scan, one, rng, room.edges))
                inside[seed].append(at_edges(scan, one, rng, room.inside))
        print(
            f"room {seed}: {', '.join(result.camera_uncertainty.names if result.camera_uncertainty else ())}",
            flush=True,
        )
    rows = []
    for kind, by_room in covered.items():
        share, error, total = clustered(by_room)
        held = abs(share - 0.95) <= 1.96 * error
        rows.append(
            Row(f"95 % intervals, {kind}", "cover 95 %", f"{share:.1%} +- {1.96 * error:.1%} of {total:,}", held)
        )
    flagged = float(np.nanmean([np.nanmean(one) for one in edge.values()]))
    false = float(np.nanmean([np.nanmean(one) for one in inside.values()]))
    rows.append(
        Row("points within a pixel of a depth edge", ">= 95 % flagged or refused", f"{flagged:.1%}", flagged >= 0.95)
    )
    rows.append(Row("points 20 px from every depth edge", "few flagged", f"{false:.1%}", false <= 0.15))
    print(table(rows))
    print(f"\n{draws} draws; {time.process_time() - started:.0f} s of processor time")


if __name__ == "__main__":
    main()
