"""Time of the perspective view, compared with OpenCV's remap with precomputed maps.

Run it as `python -m benchmarks.perspective`.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.perspective import perspective_view

ROUNDS = 25
BUDGET = 3.0


def median_ms(work: Callable[[], object]) -> float:
    """Return the median wall-clock time of a function, ms."""
    seconds = []
    for _ in range(ROUNDS):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return 1e3 * float(np.median(seconds))


def main() -> None:
    """Print the table."""
    step = np.deg2rad(0.055)
    geometry = AzimuthElevation(700, 1000, step, step)
    rng = np.random.default_rng(0)
    scan = Scan(geometry, rng.uniform(2, 3, geometry.shape), rng.uniform(0, 1, geometry.shape))
    camera = Camera.from_focal(1152, 868, 1000.0)
    view = perspective_view(scan, camera)
    columns, rows = (np.ascontiguousarray(view.cells[..., k]) for k in (0, 1))
    bare = median_ms(lambda: cv2.remap(scan.intensity, columns, rows, cv2.INTER_LINEAR))
    whole = median_ms(lambda: perspective_view(scan, camera))
    exact = geometry.cell_of(view.rays_at(np.stack(np.meshgrid(np.arange(1152), np.arange(868)), axis=-1)))
    error = float(np.abs(exact[..., ::-1] - view.cells).max())
    print(f"perspective view of {camera.width * camera.height / 1e6:.2f} Mpixel, 1000 x 700 cells, median of {ROUNDS}")
    print(f"  cv2.remap alone      {bare:7.2f} ms")
    print(f"  perspective_view     {whole:7.2f} ms   {whole / bare:.2f}x (required: <= {BUDGET:g}x)")
    print(f"  largest map error    {error:7.4f} cell (cv2.remap rounds to {1 / 32:.4f})")


if __name__ == "__main__":
    main()
