"""Calibration of the mount on simulated sweeps: rows `sweep`, `tilts` and `continuous` of the acquisition benchmark.

Run `python -m benchmarks.acquisition.mount [sweep|tilts|continuous ...] [--seeds N] [--first SEED] [--scene NAME ...]`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.shared.bars import Row, table
from ladarreg_core.acquisition.alignment.mount_calibration import calibrate_mount
from ladarreg_core.acquisition.alignment.mount_result import MountCalibration
from ladarreg_core.acquisition.simulated.recordings import Continuous, SimulatedSweep, simulate_sweep
from ladarreg_core.acquisition.simulated.world import LINE_MOUNT
from ladarreg_core.frames import Rigid, rotation_about, rotvec_from_rotation

SCENES = ("boxes", "desk", "office", "people")
HARD_SCENES = ("plain", "corridor")
SEEDS = 20
FIRST_SEED = 7000
_OFF_M, _OFF_DEG = (0.020, -0.005, 0.030), (0.4, -0.3, 0.2)
_TURN_DEG = (-150.0, 150.0)
_PAN_ONLY_TILT_DEG = -45.0
_TILTS_DEG = (-20.0, 0.0, 20.0)


def true_mount() -> Rigid:
    """Return the mount whose plan, `LINE_MOUNT`, is off by (20, -5, 30) mm and (.4, -.3, .2) deg."""
    roll, pitch, yaw = np.radians(_OFF_DEG)
    off = rotation_about("z", yaw) @ rotation_about("y", pitch) @ rotation_about("x", roll)
    return Rigid(off @ LINE_MOUNT.rotation, LINE_MOUNT.translation + np.array(_OFF_M))


def errors(found: MountCalibration, true: Rigid) -> NDArray[np.float64]:
    """Return what is left of the mount's six parameters, m and rad, in the calibration's axes."""
    left = true @ found.unit_from_scanner.inverse
    axes = rotation_about("y", -found.tilt_rad)
    return np.concatenate([axes @ left.translation, axes @ rotvec_from_rotation(left.rotation)])


def mahalanobis(found: MountCalibration, error: NDArray[np.float64]) -> float:
    """Return the squared Mahalanobis distance of the parameters that are determined, over their number."""
    seen = np.flatnonzero(found.determined)
    return float(error[seen] @ np.linalg.solve(found.covariance[np.ix_(seen, seen)], error[seen]) / len(seen))


def composed_error(recorded: SimulatedSweep, mount: Rigid, latency_s: float = 0.0) -> tuple[float, float]:
    """Return the distance of measured points from the room along its rays' surfaces, and the range noise itself.

    Both are medians of absolute values times 1.4826, m, so that edges do not count: of the points' distance to where
    they truly are, without the part that a turn and a shift of all points explain, and of the ranges' own error.
    """
    apart, noise = [], []
    for number, sweep in enumerate(recorded.sweeps):
        points = sweep.points_in_world(mount, latency_s=latency_s)
        true = recorded.true_points(number)
        use = np.isfinite(points[..., 0]) & np.isfinite(true[..., 0])
        apart.append((points[use], true[use]))
        noise.append((sweep.ranges_m - recorded.true_ranges_m[number])[use])
    points, true = (np.concatenate([part[k] for part in apart]) for k in (0, 1))
    every = max(1, len(points) // 300_000)
    points, true = points[::every], true[::every]
    left = points - true
    # The gauge: what a small turn and shift of the whole do, by least absolute deviations.
    J = np.zeros((len(true), 3, 6))
    J[:, range(3), range(3)] = 1
    x, y, z = true.T
    J[:, 0, 4], J[:, 0, 5], J[:, 1, 3], J[:, 1, 5], J[:, 2, 3], J[:, 2, 4] = z, -y, -z, x, y, -x
    size = np.linalg.norm(left, axis=-1)
    for _ in range(10):
        weight = 1 / np.maximum(size, 1e-3)
        A = np.einsum("n,nki,nkj->ij", weight, J, J)
        step = np.linalg.solve(A, np.einsum("n,nki,nk->i", weight, J, left))
        size = np.linalg.norm(left - J @ step, axis=-1)
    return float(np.median(size)), float(np.median(np.abs(np.concatenate(noise)[::every])))


def _recorded(scene: str, seed: int, tilts_deg: Sequence[float], **options: object) -> SimulatedSweep:
    pans = np.radians(np.arange(_TURN_DEG[0], _TURN_DEG[1] + 1e-9, 0.5))
    return simulate_sweep(
        scene,
        seed,
        pans_rad=pans,
        tilts_rad=np.radians(tilts_deg),
        mount=true_mount(),
        **options,  # type: ignore[arg-type]
    )


def _cases(seeds: int, first: int, scenes: Sequence[str]) -> list[tuple[str, int]]:
    return [(scenes[i % len(scenes)], first + i) for i in range(seeds)]


def sweep_row(
    *, seeds: int = SEEDS, first: int = FIRST_SEED, scenes: Sequence[str] = SCENES, show: Callable[[str], None] = print
) -> list[Row]:
    """Pan-only sweeps: four parameters are determined, two are said not to be."""
    found_all, worst, distances, as_said = [], np.zeros(6), [], 0
    for scene, seed in _cases(seeds, first, scenes):
        recorded = _recorded(scene, seed, (_PAN_ONLY_TILT_DEG,))
        found = calibrate_mount(recorded.sweeps, LINE_MOUNT)
        error = errors(found, recorded.bench.mount)
        said = found.accepted and found.determined == (True, True, False, True, True, False)
        as_said += said
        found_all.append(found)
        show(_line(scene, seed, found, error))
        if found.accepted:
            distances.append(mahalanobis(found, error))
            seen = np.array(found.determined)
            worst[seen] = np.maximum(worst[seen], np.abs(error[seen]))
    mm, deg = 1000 * worst[:2].max(), float(np.degrees(worst[3:5].max()))
    ratio = float(np.sqrt(np.mean(distances)))
    return [
        Row("pan-only sweep: shift of the mount, worst of all seeds", "<= 1 mm", f"{mm:.2f} mm", mm <= 1),
        Row("pan-only sweep: rotation of the mount, worst of all seeds", "<= .02 deg", f"{deg:.4f} deg", deg <= 0.02),
        Row("pan-only sweep: height and yaw said to be undetermined", "all", f"{as_said} of {seeds}", as_said == seeds),
        Row("pan-only sweep: RMS Mahalanobis / sqrt(dof)", ".9 to 1.1", f"{ratio:.3f}", 0.9 <= ratio <= 1.1),
    ]


def tilts_row(
    *, seeds: int = SEEDS, first: int = FIRST_SEED, scenes: Sequence[str] = SCENES, show: Callable[[str], None] = print
) -> list[Row]:
    """Sweeps at three tilts: all six, and the composed points; the wrong mount as a control."""
    ratios, controls, distances, six = [], [], [], 0
    for scene, seed in _cases(seeds, first, scenes):
        recorded = _recorded(scene, seed, _TILTS_DEG)
        found = calibrate_mount(recorded.sweeps, LINE_MOUNT)
        error = errors(found, recorded.bench.mount)
        off, noise = composed_error(recorded, found.unit_from_scanner)
        control, _ = composed_error(recorded, LINE_MOUNT)
        ratios.append(off / noise)
        controls.append(control / noise)
        six += found.accepted and all(found.determined)
        if found.accepted:
            distances.append(mahalanobis(found, error))
        show(
            _line(scene, seed, found, error)
            + f"  points {off / noise:.3f} x noise, wrong mount {control / noise:.1f} x"
        )
    ratio = float(np.sqrt(np.mean(distances)))
    return [
        Row("tilts -20, 0, 20: all six determined", "all", f"{six} of {seeds}", six == seeds),
        Row("tilts: composed points over range noise, worst", "<= 1.2", f"{max(ratios):.3f}", max(ratios) <= 1.2),
        Row("tilts: the same with the mount left wrong, best", "> 1.2", f"{min(controls):.2f}", min(controls) > 1.2),
        Row("tilts: RMS Mahalanobis / sqrt(dof)", ".9 to 1.1", f"{ratio:.3f}", 0.9 <= ratio <= 1.1),
    ]


def continuous_row(
    *, seeds: int = SEEDS, first: int = FIRST_SEED, scenes: Sequence[str] = SCENES, show: Callable[[str], None] = print
) -> list[Row]:
    """Continuous sweeps in both directions: the latency, and the composed points."""
    worst, ratios, controls = [], [], []
    for scene, seed in _cases(seeds, first, scenes):
        recorded = _recorded(scene, seed, (-20.0, 20.0), passes=2, continuous=Continuous())
        found = calibrate_mount(recorded.sweeps, LINE_MOUNT)
        error = errors(found, recorded.bench.mount)
        off, noise = composed_error(recorded, found.unit_from_scanner, found.latency_s)
        control, _ = composed_error(recorded, found.unit_from_scanner, 0.0)
        worst.append(abs(found.latency_s - recorded.latency_s))
        ratios.append(off / noise)
        controls.append(control / noise)
        show(
            _line(scene, seed, found, error)
            + f"  latency {1000 * found.latency_s:.2f} ms, points {off / noise:.3f} x, without {control / noise:.1f} x"
        )
    ms = 1000 * max(worst)
    return [
        Row("continuous, 40 ms latency, 5 ms jitter: latency, worst", "<= 2 ms", f"{ms:.2f} ms", ms <= 2),
        Row("continuous: composed points over range noise, worst", "<= 1.5", f"{max(ratios):.3f}", max(ratios) <= 1.5),
        Row("continuous: the same without latency, best", "> 1.5", f"{min(controls):.2f}", min(controls) > 1.5),
    ]


ROWS: dict[str, Callable[..., list[Row]]] = {"sweep": sweep_row, "tilts": tilts_row, "continuous": continuous_row}


def _line(scene: str, seed: int, found: MountCalibration, error: NDArray[np.float64]) -> str:
    if not found.accepted:
        return f"{scene} {seed}: not accepted: {found.reasons}"
    mm = " ".join(f"{1000 * e:.2f}+-{1000 * s:.2f}" for e, s in zip(error[:3], found.sigma[:3], strict=True))
    deg = " ".join(
        f"{e:.4f}+-{s:.4f}" for e, s in zip(np.degrees(error[3:]), np.degrees(found.sigma[3:6]), strict=True)
    )
    seen = mahalanobis(found, error) if len(found.determined) == 6 else float("nan")
    return (
        f"{scene} {seed}: {found.planes} planes, noise {1000 * found.sigma_range_m:.2f} mm, xyz {mm} mm, "
        f"rpy {deg} deg, Mahalanobis^2/dof {seen:.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", choices=list(ROWS))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--first", type=int, default=FIRST_SEED)
    parser.add_argument("--scene", nargs="*", default=list(SCENES))
    options = parser.parse_args()
    rows = [
        row
        for name in options.rows or ROWS
        for row in ROWS[name](seeds=options.seeds, first=options.first, scenes=options.scene)
    ]
    print(table(rows))


if __name__ == "__main__":
    main()
