"""Change between dates where nothing has changed: the share of points that is called significant.

    python -m benchmarks.change [--rooms 5] [--pairs 80] [--first-seed 700]

Each room is scanned from two stations; each pair has fresh noise of all ranges and another error of the second
scanner's pose, drawn from its covariance. A control is told that the pose is exact. A second control moves the second
station's surfaces by 20 mm: what share is found.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from benchmarks.shared.bars import Row, table
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.measuring.change import change
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.stations import station_room, upright_pose
from ladarreg_core.simulate.terrestrial import RangeNoise, dome_grid, scan_around

SCENES = ("office", "desk", "boxes", "people")
NOISE = RangeNoise(sigma_m=0.003)
EXACT = RangeNoise(sigma_m=0.0, resolution_m=1e-6, speckle=1e-3)
COVARIANCE = np.diag([3e-4, 3e-4, 4e-4, 2e-3, 2e-3, 2e-3]) ** 2
GRID = dome_grid(np.radians(1.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rooms", type=int, default=5)
    parser.add_argument("--pairs", type=int, default=80)
    parser.add_argument("--first-seed", type=int, default=700)
    asked = parser.parse_args()
    shares: dict[str, list[float]] = {"stated": [], "exact": [], "moved": []}
    for number in range(asked.rooms):
        seed = asked.first_seed + number
        world, caster = station_room(SCENES[number % len(SCENES)], seed)
        poses = [Rigid.identity(), upright_pose(np.array([0.4, -0.3, 0.05]), 0.5)]
        exact = [scan_around(world, caster, GRID, rng=np.random.default_rng(0), noise=EXACT, world_from_scanner=pose)
                 for pose in poses]  # fmt: skip
        rng = np.random.default_rng(seed)
        for pair in range(asked.pairs):
            before, after = (Scan(GRID, *NOISE.measured(amplitude, ranges, rng)) for ranges, amplitude in exact)
            off = rng.multivariate_normal(np.zeros(6), COVARIANCE)
            pose = Rigid(rotation_from_rotvec(-off[:3]) @ poses[1].rotation, poses[1].translation - off[3:])
            found = change(before, after, before_from_after=pose, covariance=COVARIANCE, spacing_m=0.8, radius_m=0.2)
            shares["stated"].append(found.as_fields()["significant_share"])
            if pair % 8 == 0:
                for name, asked_pose, stated in (
                    ("exact", pose, None),
                    ("moved", replace(pose, translation=pose.translation + np.array([0.02, 0, 0])), COVARIANCE),
                ):
                    one = change(before, after, before_from_after=asked_pose, covariance=stated, spacing_m=0.8,
                                 radius_m=0.2)  # fmt: skip
                    shares[name].append(one.as_fields()["significant_share"])
        print(f"room {seed}: {np.mean(shares['stated']):.3f} so far", flush=True)
    stated, control, moved = (float(np.mean(shares[name])) for name in shares)
    pairs = len(shares["stated"])
    print(table([
        Row(f"significant share, {pairs} null pairs", "mean 4 to 6 %", f"{stated:.1%}", 0.04 <= stated <= 0.06),
        Row("the same, told that the pose is exact", "exceeds it (control)", f"{control:.1%}", control > 0.06),
        Row("the second scanner 20 mm off", "exceeds it (control)", f"{moved:.1%}", moved > stated),
    ]))  # fmt: skip


if __name__ == "__main__":
    main()
