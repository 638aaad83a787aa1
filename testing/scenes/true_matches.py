"""Matches of the embedded sample that are right, from its true pose."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

import ladarreg_core as lr
from ladarreg_core.simulate.sample import sample_folder


def true_points(count: int, *, seed: int = 0, noise_px: float = 0.3) -> list[dict[str, Any]]:
    """Return points all over the photograph as fields of the command `add_pick`."""
    folder = sample_folder()
    scan = lr.read_scan(folder / "scan.npz")
    camera = lr.read_photo(next(folder.glob("photo.*")), camera=folder / "camera.json").camera
    truth = lr.Rigid.from_matrix(json.loads((folder / "truth.json").read_text())["camera_from_scanner"])
    rng = np.random.default_rng(seed)
    ranges = np.where(scan.valid, scan.ranges, np.nan)
    # on smooth surfaces only: at an edge the range of a ray is not that of its cell
    smooth = np.ones(scan.shape, bool)
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        smooth &= np.abs(np.roll(ranges, shift, (0, 1)) - ranges) < 0.03
    uv = camera.project(truth @ scan.points.reshape(-1, 3)).reshape(*scan.shape, 2)
    seen = smooth & camera.contains(uv.reshape(-1, 2), border=30).reshape(scan.shape)
    cells = np.argwhere(seen)
    found = []
    for row, column in cells[rng.permutation(len(cells))[:count]]:
        point = scan.points[row, column]
        found.append(
            {
                "kind": "point",
                "scan": [(point / np.linalg.norm(point)).tolist()],
                "photo_uv": [(uv[row, column] + rng.normal(0, noise_px, 2)).tolist()],
            }
        )
    return found
