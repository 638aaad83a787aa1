"""Cameras of which only the focal length is known: is the stated uncertainty of the pose right?

    python -m benchmarks.assumed_camera [--cases 24] [--first-seed 0] [--automatic N]

The principal point and k1 of every case are drawn from the prior. Consistency is the RMS Mahalanobis distance of the
pose to the truth / sqrt 6, by the reported covariance: 1 where the stated uncertainty is right.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import DEFAULT_CAMERA_PRIOR
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.quality.assessment import assess
from ladarreg_core.registration.register import register
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan
from ladarreg_core.simulate import SCENES, simulate_case
from testing.scenes.pose_case import difference
from testing.scenes.room import ROOM_CAMERA
from testing.scenes.room_lines import line_case

LINES = 11
LEAST, MOST = 0.8, 1.2
"""Bar of the consistency."""
_CROPPED = (704, 470)


@dataclass(frozen=True)
class Row:
    """One case."""

    accepted: bool
    accepted_exact: bool
    """The same with the camera as stated taken as exact."""
    distance: float
    """Mahalanobis distance to the truth / sqrt 6."""
    distance_exact: float
    error_deg: float
    sigma_deg: float
    error_exact_deg: float
    picture_px: float
    """Median uncertainty of the photo position."""


def drawn_camera(seed: int, camera: Camera = ROOM_CAMERA) -> Camera:
    """Return a true camera whose principal point and k1 are drawn from the prior about those of a camera."""
    rng = np.random.default_rng([seed, 4711])
    sigmas = DEFAULT_CAMERA_PRIOR.sigmas(camera)
    k1, cx, cy = rng.normal(size=3) * [sigmas["k1"], sigmas["cx"], sigmas["cy"]]
    return replace(camera, cx=camera.cx + cx, cy=camera.cy + cy, distortion=(k1, 0.0, 0.0, 0.0))


def lines_row(seed: int, *, lines: int = LINES, true_camera: Camera | None = None) -> Row:
    """Register drawn lines, stated as taken by an ideal camera of the same focal length."""
    case = line_case(seed, lines=lines, camera=true_camera or drawn_camera(seed))
    photo = Photo(np.zeros((*case.camera.size[::-1], 3), np.uint8), ROOM_CAMERA, assumed=True)
    return _row(case.scan, photo, case.pose, lambda of: register(case.scan, of, method="manual", picks=case.picks))


def automatic_row(seed: int) -> Row:
    """Register a simulated pair automatically; the photo is cut out of a larger one, off its middle."""
    rng = np.random.default_rng([seed, 4712])
    width, height = _CROPPED
    sigmas = DEFAULT_CAMERA_PRIOR.sigmas(Camera.from_focal(width, height, 974.0))
    case = simulate_case(sorted(SCENES)[seed % len(SCENES)], seed=700 + seed, k1=float(rng.normal() * sigmas["k1"]))
    wide = case.photo.pixels
    room = ((wide.shape[1] - width) / 2, (wide.shape[0] - height) / 2)
    left, top = (
        round(float(np.clip(half + rng.normal() * sigmas[name], 0, 2 * half)))
        for half, name in zip(room, ("cx", "cy"), strict=True)
    )
    pixels = np.ascontiguousarray(wide[top : top + height, left : left + width])
    photo = Photo(pixels, Camera.from_focal(width, height, case.true_camera.fx), assumed=True)
    return _row(case.scan, photo, case.camera_from_scanner, lambda of: register(case.scan, of))


def _row(scan: Scan, photo: Photo, truth: Rigid, solve: Callable[[Photo], Registration]) -> Row:
    result, exact = solve(photo), solve(replace(photo, assumed=False))
    uncertainty = assess(scan, result).uncertainty
    off, off_exact = (difference(truth, r.camera_from_scanner) for r in (result, exact))

    def distance(step: np.ndarray, covariance: np.ndarray) -> float:
        return float(np.sqrt(step @ np.linalg.solve(covariance, step) / 6))

    return Row(
        result.accepted,
        exact.accepted,
        distance(off, result.covariance),
        distance(off_exact, exact.covariance),
        float(np.degrees(np.linalg.norm(off[:3]))),
        float(np.degrees(result.sigma_angle_rad)),
        float(np.degrees(np.linalg.norm(off_exact[:3]))),
        float("nan") if uncertainty is None else uncertainty.median_px,
    )


def consistency(rows: list[Row], *, exact: bool = False) -> float:
    """Return the RMS Mahalanobis distance / sqrt 6 of the accepted cases."""
    found = [row.distance_exact if exact else row.distance for row in rows if row.accepted]
    return float(np.sqrt(np.mean(np.square(found)))) if found else float("nan")


def _report(title: str, rows: list[Row]) -> None:
    figure = consistency(rows)
    bar = "met" if LEAST <= figure <= MOST else "MISSED"
    print(f"{title}: {len(rows)} cases")
    print(f"  consistency {figure:.2f} (bar {LEAST} to {MOST}: {bar}); camera taken as exact: "
          f"{consistency(rows, exact=True):.2f}")  # fmt: skip
    accepted = [row for row in rows if row.accepted] or rows
    print(
        f"  orientation: median error {np.median([r.error_deg for r in accepted]):.3f} deg, stated "
        f"{np.median([r.sigma_deg for r in accepted]):.3f} deg; camera taken as exact: error "
        f"{np.median([r.error_exact_deg for r in accepted]):.3f} deg"
    )
    print(f"  median uncertainty of the photo position {np.nanmedian([r.picture_px for r in accepted]):.2f} px")
    lost = sum(row.accepted_exact and not row.accepted for row in rows)
    print(f"  accepted {sum(r.accepted for r in rows)}, as exact {sum(r.accepted_exact for r in rows)}, lost {lost}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=24, help="cases with drawn lines")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--automatic", type=int, default=0, metavar="N", help="automatic cases as well, slow")
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.cases)
    _report(f"{LINES} drawn lines", [lines_row(seed) for seed in seeds])
    if arguments.automatic:
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.automatic)
        _report("Automatic", [automatic_row(seed) for seed in seeds])


if __name__ == "__main__":
    main()
