"""Where to look from the scanner: one view for a narrow scan, several for one that no photo can take in at once."""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.perspective import look_along
from ladarreg_core.scan import Scan

_STEP = 0.6
_MARGIN = 1.4
_LEAST_SHARE = 0.05


def viewing_directions(scan: Scan, camera: Camera, *, initial: Rigid | None = None) -> list[Rigid]:
    """Return the rotations (view from scanner) to try, likeliest first.

    Args:
        scan: the scan.
        camera: the working camera, whose field of view one view has.
        initial: a rough pose; its optical axis is looked along first.

    Returns:
        one or more. A scan that is not much wider than the photo is seen along its mean return; a wider one in steps
        of a bit over half the photo's width, the best filled first.
    """
    found = []
    if initial is not None:
        found.append(Rigid(look_along(initial.rotation[2]), np.zeros(3)))
    rays = scan.sampled_directions
    centre = scan.mean_direction
    half_width = np.arctan(0.5 * camera.width / camera.fx)
    azimuth = np.arctan2(rays[:, 1], rays[:, 0])
    spread = _wrapped(azimuth - np.arctan2(centre[1], centre[0]))
    reach = float(np.percentile(np.abs(spread), 98))
    first = Rigid(look_along(centre), np.zeros(3))
    if reach <= _MARGIN * half_width:
        return [*found, first]
    step = 2 * half_width * _STEP
    count = int(np.ceil(2 * min(reach, np.pi) / step))
    scored = []
    for turn in (np.arange(count) - (count - 1) / 2) * step:
        angle = np.arctan2(centre[1], centre[0]) + turn
        near = np.abs(_wrapped(azimuth - angle)) < half_width
        if near.mean() < _LEAST_SHARE:
            continue
        elevation = float(np.median(np.arcsin(np.clip(rays[near, 2], -1, 1))))
        direction = [np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation)]
        scored.append((abs(turn), Rigid(look_along(direction), np.zeros(3))))
    scored.sort(key=lambda item: item[0])
    return [*found, *(view for _, view in scored)] or [first]


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
