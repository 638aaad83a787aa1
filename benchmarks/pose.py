"""Pose estimation against its bounds and its peers: python -m benchmarks.pose [--seeds N].

The room: points on the walls, the floor and three boxes of a room, 2 to 6 m away in the view of a 768 x 512 camera
with f = 974 px (50 degrees across the diagonal); 1 px and 15 mm of noise, half a metre between scanner and camera.
The apple: Table 3.1 of the thesis in three readings.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.errors import LadarregError
from ladarreg_core.frames import (
    CAMERA_AXES_FROM_SCANNER,
    Rigid,
    ThesisParameters,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import Measurements, States, information_matrix
from ladarreg_core.pose.epipolar import epipolar_cost
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.ransac import ransac_pose
from ladarreg_core.pose.stereo import StereoPairs, stereo_cost
from ladarreg_core.pose.stereo_simplex import Residual, SimplexOptions, fit_simplex

ROOM_CAMERA = Camera.from_focal(768, 512, 974.0)
ROOM_WALLS = (np.array([-1.0, -2.4, -1.2]), np.array([5.6, 2.4, 1.5]))
ROOM_BOXES = (
    (np.array([2.2, -0.9, -1.2]), np.array([2.7, -0.35, -0.1])),
    (np.array([2.9, 0.3, -1.2]), np.array([3.6, 1.2, 0.15])),
    (np.array([4.3, -1.2, -1.2]), np.array([5.0, -0.2, 0.8])),
)


@dataclass(frozen=True)
class Case:
    """Matches with their truth."""

    rays: np.ndarray
    ranges: np.ndarray
    uv: np.ndarray
    camera: Camera
    pose: Rigid
    true: np.ndarray
    """(N,) bool: not mismatched."""
    sigma_px: float
    sigma_range_m: float

    @property
    def matches(self) -> Matches:
        return Matches(self.rays, self.ranges, self.uv)

    def bound(self) -> np.ndarray:
        """The Fisher information (6, 6) of the true matches at the true pose."""
        measured = Measurements.of(
            self.matches.subset(self.true), self.camera, sigma_px=self.sigma_px, sigma_range_m=self.sigma_range_m
        )
        return information_matrix(measured, States.of([self.pose], measured))[0]


def room_ranges(rays: np.ndarray) -> np.ndarray:
    """The distance (N,) to the first surface of the room along unit rays (N, 3) from its origin."""
    with np.errstate(divide="ignore"):
        inverse = 1 / np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    ranges = np.maximum(inverse * ROOM_WALLS[0], inverse * ROOM_WALLS[1]).min(axis=1)
    for low, high in ROOM_BOXES:
        near = np.minimum(inverse * low, inverse * high).max(axis=1)
        far = np.maximum(inverse * low, inverse * high).min(axis=1)
        ranges = np.where((near < far) & (near > 0), np.minimum(ranges, near), ranges)
    return ranges


def room_case(
    seed: int,
    *,
    count: int = 200,
    outliers: float = 0.0,
    baseline_m: float = 0.5,
    direction: tuple[float, float, float] | None = None,
    sigma_px: float = 1.0,
    sigma_range_m: float = 0.015,
    camera: Camera = ROOM_CAMERA,
) -> Case:
    """Matches in the room; the camera stands `baseline_m` away, by default anywhere but mostly beside the scanner."""
    rng = np.random.default_rng([seed, count, int(outliers * 100)])
    way = rng.normal(size=3) * [0.4, 1.0, 0.5] if direction is None else np.array(direction)
    centre = way / np.linalg.norm(way) * baseline_m
    # It looks at the middle of what the scanner sees, give or take a few degrees.
    pan = np.arctan2(centre[1], 4.0 - centre[0])
    turn = rotation_from_rotvec(rng.normal(size=3) * np.deg2rad(3)) @ rotation_from_rotvec([0, -pan, 0])
    pose = Rigid.from_centre(turn @ CAMERA_AXES_FROM_SCANNER, centre)
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < count:
        tangents = rng.uniform(-1.1, 1.1, (4 * count, 2)) * [
            camera.width / 2 / camera.fx,
            camera.height / 2 / camera.fy,
        ]
        rays = np.column_stack([np.ones(len(tangents)), -tangents])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        ranges = room_ranges(rays)
        seen = camera.contains(camera.project(pose @ (rays * ranges[:, None]))) & (ranges > 2) & (ranges < 6)
        kept.append(rays[seen])
    rays = np.concatenate(kept)[:count]
    ranges = room_ranges(rays)
    uv = camera.project(pose @ (rays * ranges[:, None])) + rng.normal(size=(count, 2)) * sigma_px
    wrong = rng.permutation(count) < round(outliers * count)
    uv[wrong] = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (int(wrong.sum()), 2))
    return Case(
        rays, ranges + rng.normal(size=count) * sigma_range_m, uv, camera, pose, ~wrong, sigma_px, sigma_range_m
    )


APPLE_TRUTH = ThesisParameters(5.0, 2.0, 2.0, *np.deg2rad([25.0, 10.0, 5.0]))
APPLE_READINGS = {"A": (1.0, 256.0, False), "B": (3.0, 128.0, False), "C": (3.0, 256.0, True)}
"""Radius, focal length in px, and whether the spikes are all of 3 units."""


def apple_points(reading: str) -> np.ndarray:
    """The apple's 208 vertices, scanner frame."""
    radius, _, _ = APPLE_READINGS[reading]
    t, phi = (
        a.ravel() for a in np.meshgrid(np.linspace(0.12, np.pi - 0.12, 13), np.arange(16) * np.pi / 8, indexing="ij")
    )
    rho = (1 - 0.35 * np.exp(-((t / 0.45) ** 2)) - 0.2 * np.exp(-(((np.pi - t) / 0.4) ** 2))) * (1 + 0.08 * np.cos(t))
    rho /= np.abs(rho * np.sin(t)).max()
    apple = np.column_stack([rho * np.sin(t) * np.cos(phi), -rho * np.cos(t), rho * np.sin(t) * np.sin(phi)])
    c, s = np.cos(0.35), np.sin(0.35)
    apple = apple @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T * radius + [0, 0, 5]
    return apple @ CAMERA_AXES_FROM_SCANNER


def apple_case(reading: str, seed: int) -> Case:
    """Table 3.1: 208 vertices of an apple, uniform noise on ranges and pixels, spikes on a tenth of the ranges."""
    _, focal, fixed_spikes = APPLE_READINGS[reading]
    rng = np.random.default_rng([seed, ord(reading)])
    points = apple_points(reading)
    ranges = np.linalg.norm(points, axis=1)
    rays = points / ranges[:, None]
    camera = Camera(512, 512, focal, focal, 255.5, 255.5)
    n = len(points)
    uv = np.rint(camera.project(APPLE_TRUTH.pose @ points) + rng.uniform(-3, 3, (n, 2)))
    spike = rng.permutation(n) < round(n / 10)
    height = np.where(rng.random(n) < 0.5, -1.0, 1.0) * (3.0 if fixed_spikes else rng.uniform(0, 3, n))
    ranges = ranges + rng.uniform(-0.25, 0.25, n) + spike * height
    return Case(
        rays,
        np.maximum(ranges, 0.05),
        uv,
        camera,
        APPLE_TRUTH.pose,
        ~spike,
        float(np.sqrt(3 + 1 / 12)),
        0.25 / np.sqrt(3),
    )


def apple_error_percent(pose: Rigid) -> float:
    """Mean |error| over the six parameters, per cent of each."""
    found, truth = ThesisParameters.from_pose(pose), APPLE_TRUTH
    names = ("Tx", "Ty", "Tz", "alpha", "beta", "gamma")
    return 100 * float(np.mean([abs(getattr(found, k) / getattr(truth, k) - 1) for k in names]))


def difference(truth: Rigid, found: Rigid) -> np.ndarray:
    """(6,) w and c of `PoseResult.covariance`."""
    return np.concatenate([rotvec_from_rotation(truth.rotation @ found.rotation.T), truth.centre - found.centre])


Solver = Callable[[Case], "tuple[Rigid, np.ndarray | None] | None"]


def default(case: Case, *, matches: Matches | None = None, **options: object) -> tuple[Rigid, np.ndarray] | None:
    chosen = PoseOptions(sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m, **options)  # type: ignore[arg-type]
    try:
        result = solve_pose(matches or case.matches, case.camera, chosen)
    except LadarregError:
        return None
    return result.camera_from_scanner, result.covariance


def default_unstated(case: Case) -> tuple[Rigid, np.ndarray] | None:
    result = solve_pose(case.matches, case.camera, PoseOptions())
    return result.camera_from_scanner, result.covariance


def default_without_poselib(case: Case) -> tuple[Rigid, np.ndarray] | None:
    return default(case, ransac_backend="opencv")


def known_inliers(case: Case) -> tuple[Rigid, np.ndarray] | None:
    return default(case, matches=case.matches.subset(case.true), gate_chi2=1e6)


def ransac_alone(case: Case) -> tuple[Rigid, None] | None:
    found = ransac_pose(case.matches.points, case.uv, case.camera, threshold_px=6 * case.sigma_px)
    return (found.camera_from_scanner, None) if found else None


def poselib_peer(case: Case) -> tuple[Rigid, None] | None:
    import poselib

    c = case.camera
    lens = {"model": "PINHOLE", "width": c.width, "height": c.height, "params": [c.fx, c.fy, c.cx, c.cy]}
    pose, _ = poselib.estimate_absolute_pose(
        case.uv, case.matches.points, lens, {"max_reproj_error": 6 * case.sigma_px, "max_iterations": 5000}
    )
    return Rigid(pose.R, pose.t), None


def opencv_peer(case: Case) -> tuple[Rigid, None] | None:
    cv2.setRNGSeed(0)
    points, K = np.array(case.matches.points), case.camera.matrix
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, case.uv, K, None, iterationsCount=5000, reprojectionError=6 * case.sigma_px, confidence=0.9999
    )
    if not found:
        return None
    keep = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[keep], case.uv[keep], K, None, turn, shift)
    return Rigid(cv2.Rodrigues(turn)[0], shift.ravel()), None


def sqpnp_known_inliers(case: Case) -> tuple[Rigid, None] | None:
    keep = case.true
    found, turn, shift = cv2.solvePnP(
        np.array(case.matches.points[keep]), case.uv[keep], case.camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP
    )
    return (Rigid(cv2.Rodrigues(turn)[0], shift.ravel()), None) if found else None


PEERS: dict[str, Solver] = {
    "default": default,
    "default, noise not stated": default_unstated,
    "default, OpenCV's RANSAC": default_without_poselib,
    "default, true inliers known": known_inliers,
    "our RANSAC alone": ransac_alone,
    "poselib RANSAC + bundle": poselib_peer,
    "OpenCV RANSAC + refineLM": opencv_peer,
    "OpenCV SQPnP, true inliers": sqpnp_known_inliers,
}


@dataclass(frozen=True)
class Figures:
    """What a solver reached over many seeds."""

    success: float
    efficiency: float
    consistency: float
    position_mm: float
    milliseconds: float


def measure(solver: Solver, cases: list[Case]) -> Figures:
    """Success (Mahalanobis distance <= 6 by the bound), efficiency and consistency over the successes, and the time."""
    variance, bound, distance, position, seconds, success = [], [], [], [], [], 0
    for case in cases:
        start = time.perf_counter()
        found = solver(case)
        seconds.append(time.perf_counter() - start)
        if found is None:
            position.append(np.inf)
            continue
        step, H = difference(case.pose, found[0]), case.bound()
        position.append(float(np.linalg.norm(step[3:])))
        if step @ H @ step > 36:
            continue
        success += 1
        variance.append(step**2)
        bound.append(np.diag(np.linalg.inv(H)))
        if found[1] is not None:
            distance.append(step @ np.linalg.solve(found[1], step))
    return Figures(
        success / len(cases),
        float(np.mean(np.mean(bound, axis=0) / np.mean(variance, axis=0))) if variance else np.nan,
        float(np.sqrt(np.mean(distance) / 6)) if distance else np.nan,
        1000 * float(np.median(position)),
        1000 * float(np.median(seconds)),
    )


def apple_figures(solver: Solver, reading: str, seeds: int) -> tuple[float, float]:
    """Median and 95th percentile of the mean |error| %, over seeds."""
    errors = []
    for seed in range(seeds):
        found = solver(apple_case(reading, seed))
        errors.append(apple_error_percent(found[0]) if found else np.inf)
    return float(np.median(errors)), float(np.percentile(errors, 95))


THESIS_START = ThesisParameters(2.0, 0.0, 0.0, 0.0, 0.0, 0.0).pose
"""'Two meter translation', and no rotation: the start of thesis 3.2."""


def linear(case: Case) -> tuple[Rigid, np.ndarray] | None:
    return default(case, method="linear")


def simplex_poses(
    case: Case, residual: Residual, *, start: Rigid | None = THESIS_START, threshold_m: float | None = None, restarts=2
) -> tuple[Rigid, Rigid]:
    """The simplex's poses before and after rejection; threshold None: from the data."""
    options = SimplexOptions(residual=residual, reject_depth_m=threshold_m, restarts=restarts)
    fit = fit_simplex(case.matches, case.camera, options, initial=start, sigma_px=case.sigma_px)
    return fit.before.camera_from_scanner, fit.after.camera_from_scanner


def simplex_apple_figures(residual: Residual, reading: str, seeds: range, threshold: float | None) -> np.ndarray:
    """Mean |error| % of every seed, (N, 2): all points, outliers rejected."""
    errors = []
    for seed in seeds:
        poses = simplex_poses(apple_case(reading, seed), residual, threshold_m=threshold)
        errors.append([apple_error_percent(pose) for pose in poses])
    return np.array(errors)


def start_near(case: Case, seed: int, degrees: float, metres: float) -> Rigid:
    """A start so far from the truth, any way."""
    rng = np.random.default_rng([seed, 5])
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = rotation_from_rotvec(axis * np.deg2rad(degrees))
    return Rigid.from_centre(turn @ case.pose.rotation, case.pose.centre + metres * way)


def evaluations_per_second(cost: Callable[[np.ndarray], float], x: np.ndarray, *, rounds: int = 15) -> float:
    """The best of some rounds: what others do meanwhile only slows."""
    seconds = []
    for _ in range(rounds):
        begin = time.perf_counter()
        for _ in range(2000):
            cost(x)
        seconds.append(time.perf_counter() - begin)
    return 2000 / min(seconds)


def picture_difference_px(case: Case, a: Rigid, b: Rigid) -> float:
    """The median displacement of the case's points between two poses, photo pixels."""
    points = case.matches.points
    return float(
        np.nanmedian(np.linalg.norm(case.camera.project(a @ points) - case.camera.project(b @ points), axis=1))
    )


def thesis_report(seeds: int) -> None:
    """The thesis's nonlinear estimation."""
    case = room_case(0)
    pairs = StereoPairs.of(case.matches, case.camera)
    for cost in (stereo_cost, epipolar_cost):
        rate = evaluations_per_second(cost(pairs), pairs.parameters(case.pose))
        print(f"{cost.__name__}, n = 200: {rate:,.0f} evaluations a second")

    print("Table 3.1, mean |error| %: median / 95th percentile, start T = (2, 0, 0)")
    rows: dict[str, list[np.ndarray]] = {"linear": []}
    for reading in APPLE_READINGS:
        found = [linear(apple_case(reading, seed)) for seed in range(seeds)]
        rows["linear"].append(np.array([apple_error_percent(f[0]) if f else np.inf for f in found]))
        for residual, threshold in (("stereo", 0.5), ("stereo", None), ("epipolar", None)):
            errors = simplex_apple_figures(residual, reading, range(seeds), threshold)  # type: ignore[arg-type]
            name = f"{residual}-simplex, {'threshold .5' if threshold else 'own threshold'}"
            rows.setdefault(f"{residual}-simplex, all points", []).append(errors[:, 0])
            rows.setdefault(f"{name}, rejected", []).append(errors[:, 1])
    for name, row in rows.items():
        row = row[:: len(row) // 3]  # both thresholds begin with the same descent
        cells = (
            f"  {k} {np.median(e):6.2f} /{np.percentile(e, 95):7.2f}" for k, e in zip(APPLE_READINGS, row, strict=True)
        )
        print(f"  {name:42}" + "".join(cells))

    print("room, n = 200, no mismatches: share within 5 cm of the truth, one descent / with restarts and rejection")
    for name, far in (("5 deg, .25 m", (5.0, 0.25)), ("10 deg, .5 m", (10.0, 0.5)), ("2 m left", None)):
        for residual in ("stereo", "epipolar"):
            reached = np.zeros(2)
            for seed in range(seeds):
                case = room_case(seed)
                start = start_near(case, seed, *far) if far else THESIS_START
                for k, restarts in enumerate((0, 2)):
                    pose = simplex_poses(case, residual, start=start, restarts=restarts)[k]  # type: ignore[arg-type]
                    reached[k] += pose.distance_to(case.pose) < 0.05
            print(f"  from {name:14} {residual:9} {reached[0] / seeds:6.2f} {reached[1] / seeds:6.2f}")

    print("room, n = 200, own start: median mm, share accepted, consistency")
    for outliers in (0.0, 0.1, 0.3):
        for method in ("linear", "stereo_simplex", "epipolar_simplex"):
            cases = [room_case(seed, outliers=outliers) for seed in range(seeds)]
            _row(f"{outliers:.0%} mismatches, {method}", cases, method)
    print("baseline, n = 150, no mismatches: median mm, share accepted, consistency")
    for baseline, way in ((0.0, None), (0.01, None), (0.05, None), (0.2, None), (0.5, None), (0.5, (1.0, 0.0, 0.0))):
        cases = [room_case(seed, count=150, baseline_m=baseline, direction=way) for seed in range(seeds)]
        for method in ("stereo_simplex", "epipolar_simplex"):
            _row(f"{baseline:4.2f} m {'forward, ' if way else ''}{method}", cases, method)

    print("from good matches (n = 150, .3 px, 5 mm, baseline .3 to 1 m), against the default: median px, median mm")
    gaps: dict[str, list[tuple[float, float]]] = {}
    for seed in range(seeds):
        baseline = float(np.random.default_rng([seed, 9]).uniform(0.3, 1.0))
        case = room_case(seed, count=150, sigma_px=0.3, sigma_range_m=0.005, baseline_m=baseline, direction=(0, 1, 0.1))
        best = default(case)
        assert best is not None
        for method in ("linear", "stereo_simplex", "epipolar_simplex"):
            found = default(case, method=method)
            if found:
                gap = picture_difference_px(case, found[0], best[0]), 1000 * found[0].distance_to(best[0])
                gaps.setdefault(method, []).append(gap)
    for method, rows_of in gaps.items():
        px, mm = np.median(rows_of, axis=0)
        print(f"  {method:18} {px:6.3f} px (worst {np.max(rows_of, axis=0)[0]:.2f}) {mm:7.2f} mm")


def _row(name: str, cases: list[Case], method: str) -> None:
    position, accepted, distance = [], 0, []
    for case in cases:
        options = PoseOptions(method=method, sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m)  # type: ignore[arg-type]
        try:
            result = solve_pose(case.matches, case.camera, options)
        except LadarregError:
            position.append(np.inf)
            continue
        step = difference(case.pose, result.camera_from_scanner)
        position.append(float(np.linalg.norm(step[3:])))
        accepted += result.accepted
        distance.append(step @ np.linalg.solve(result.covariance, step) / 6)
    consistency = np.sqrt(np.median(distance) / 0.891) if distance else np.nan  # chi^2 with 6 degrees: median 5.35
    print(f"  {name:36} {1000 * np.median(position):9.2f} {accepted / len(cases):6.2f} {consistency:6.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--thesis", action="store_true", help="the thesis's nonlinear estimation alone")
    arguments = parser.parse_args()
    seeds = arguments.seeds
    thesis_report(seeds)
    if arguments.thesis:
        return
    print(f"room, n = 200, baseline .5 m, {seeds} seeds: success, efficiency, consistency, median mm, median ms")
    for outliers in (0.0, 0.3, 0.5, 0.7):
        cases = [room_case(seed, outliers=outliers) for seed in range(seeds)]
        print(f"  {outliers:.0%} mismatches")
        for name, solver in PEERS.items():
            f = measure(solver, cases)
            print(f"    {name:28} {f.success:6.3f} {f.efficiency:6.2f} {f.consistency:6.2f}", end="")
            print(f" {f.position_mm:7.2f} {f.milliseconds:7.2f}")
    print("baseline, n = 150, no mismatches: median mm")
    for baseline, way in ((0.0, None), (0.01, None), (0.05, None), (0.2, None), (0.5, None), (0.5, (1.0, 0.0, 0.0))):
        cases = [room_case(seed, count=150, baseline_m=baseline, direction=way) for seed in range(seeds)]
        print(f"  {baseline:4.2f} m {'forward' if way else '':8}{measure(default, cases).position_mm:6.2f}")
    print("Table 3.1, mean |error| %: median / 95th percentile")
    for name in ("default", "default, noise not stated", "default, true inliers known", "poselib RANSAC + bundle"):
        row = [apple_figures(PEERS[name], reading, seeds) for reading in APPLE_READINGS]
        print(
            f"  {name:28}" + "".join(f"  {k} {a:5.2f} /{b:6.2f}" for k, (a, b) in zip(APPLE_READINGS, row, strict=True))
        )


if __name__ == "__main__":
    main()
