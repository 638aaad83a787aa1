"""Mounts of cameras on pan/tilt units, from their own photographs: rows of `python -m benchmarks.stations`."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np

from benchmarks.shared.bars import Row
from ladarreg_core.frames import rotvec_from_rotation
from ladarreg_core.registration.rig.unit_camera import register_unit_camera
from testing.scenes.unit_camera import simulate_unit_camera

_FIRST_SEED = 9100


def unit_camera_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """A swept panorama and four photographs in each of many rooms; then photographs of another room."""
    count = 3 if quick else 20
    errors, distances, accepted = [], [], 0
    for seed in range(_FIRST_SEED, _FIRST_SEED + count):
        case = simulate_unit_camera(seed)
        found = register_unit_camera(case.panorama, case.photos, case.units, is_scanner_mount_known=True)
        accepted += found.accepted
        row: dict[str, object] = {"seed": seed, "result": found.sentence}
        if found.unit_from_camera is not None:
            true, pose = case.mount.inverse, found.unit_from_camera.inverse
            turn = rotvec_from_rotation(true.rotation @ pose.rotation.T)
            error = np.concatenate([turn, true.centre - pose.centre])
            errors.append(1000 * float(np.linalg.norm(error[3:])))
            distances.append(float(np.sqrt(error @ np.linalg.solve(found.covariance, error) / 6)))
            row |= {"mm": errors[-1], "mahalanobis": distances[-1]}
        show(json.dumps(row))
    strangers = 1 if quick else 5
    wrong = 0
    for seed in range(_FIRST_SEED, _FIRST_SEED + strangers):
        case = simulate_unit_camera(seed, photographs_of=seed + 500)
        wrong += register_unit_camera(case.panorama, case.photos, case.units, is_scanner_mount_known=True).accepted
    rms = float(np.sqrt(np.mean(np.square(distances)))) if distances else float("nan")
    return [
        Row("camera on a unit: accepted", "all", f"{accepted} of {count}", accepted == count),
        Row("camera on a unit: position, median (worst)", "-", f"{np.median(errors):.1f} ({max(errors):.1f}) mm", True),
        Row("camera on a unit: Mahalanobis / sqrt 6, RMS", ".9 to 1.2", f"{rms:.2f}", 0.9 <= rms <= 1.2),
        Row("camera on a unit: of another room, accepted", "0", f"{wrong} of {strangers}", wrong == 0),
    ]
