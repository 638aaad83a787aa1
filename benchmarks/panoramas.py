"""Automatic registration of equirectangular and fisheye photographs of simulated rooms, and their refusal elsewhere.

    python -m benchmarks.panoramas [--cases 12] [--others 50] [--narrow 4] [--first 0]

Prints one line per registration, then a table and the worst cases. Every photograph is 4096 x 2048 (equirectangular)
or 2400 x 2400 (fisheye, 190 deg); the scans are domes with 0.1 deg between rays. The back of every second panorama
faces the subject, so that its seam runs through it; three of eight photographs are rolled by 90 deg. A photograph with
the scan of another room must be refused.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import ladarreg_core as lr
from ladarreg_core.simulate.panorama import PanoramaCase, PanoramaOptions, WideLens, simulate_panorama
from ladarreg_core.simulate.worlds.scenes import SCENES

_SCENES = tuple(SCENES)
_WIDTH: dict[WideLens, int] = {"equirectangular": 4096, "fisheye": 2400}
_ROLLED_OF_EIGHT = (1, 4, 6)
_NARROW_DEG = 120.0
_BARS = "median <= .02 deg and 3 mm, worst .05 deg and 6 mm, none accepted elsewhere"


@dataclass(frozen=True)
class Outcome:
    """One registration."""

    name: str
    accepted: bool
    angle_deg: float
    distance_mm: float
    fraction: float
    seconds: float
    reason: str

    def line(self) -> str:
        """Return it as a line."""
        verdict = "accepted" if self.accepted else "refused "
        where = f"{self.angle_deg:8.4f} deg {self.distance_mm:8.2f} mm" if np.isfinite(self.angle_deg) else " " * 24
        return f"{self.name:<44} {verdict} {where} {self.fraction:5.0%} {self.seconds:6.1f} s  {self.reason[:70]}"


def options_of(lens: WideLens, number: int) -> PanoramaOptions:
    """Return what the photograph of a number looks like."""
    seam = lens == "equirectangular" and number % 2 == 0
    return PanoramaOptions(lens=lens, width=_WIDTH[lens], seam=seam, rolled=number % 8 in _ROLLED_OF_EIGHT)


def cases(lens: WideLens, first: int, count: int, *, narrow: bool = False) -> Iterator[tuple[str, PanoramaCase]]:
    """Yield the cases of a lens, each with its name."""
    for number in range(first, first + count):
        scene, options = _SCENES[number % len(_SCENES)], options_of(lens, number)
        if narrow:
            options = replace(options, scan_width_deg=_NARROW_DEG)
        marks = "".join([" seam" * options.seam, " rolled" * options.rolled, " narrow" * narrow])
        yield f"{lens} {scene} {number}{marks}", simulate_panorama(scene, seed=number, options=options)


def registered(name: str, case: PanoramaCase, scan: lr.Scan | None = None) -> Outcome:
    """Register a photograph with its scan, or with another one."""
    start = time.perf_counter()
    result = lr.register(scan or case.scan, case.photo)
    seconds = time.perf_counter() - start
    pose, truth = result.camera_from_scanner, case.camera_from_scanner
    verdict = result.diagnostics.get("verification", {})
    return Outcome(
        name,
        result.accepted,
        float("nan") if scan is not None else float(np.degrees(pose.angle_to(truth))),
        float("nan") if scan is not None else 1000 * pose.distance_to(truth),
        float(verdict.get("fraction", 0.0)),
        seconds,
        "" if result.accepted else result.reasons[0],
    )


def table(found: list[Outcome]) -> str:
    """Return the table of one group."""
    good = [outcome for outcome in found if outcome.accepted]
    lines = [f"accepted {len(good)} of {len(found)}; median {np.median([o.seconds for o in found]):.0f} s"]
    if good:
        for label, values in (
            ("angle, deg", [o.angle_deg for o in good]),
            ("position, mm", [o.distance_mm for o in good]),
        ):
            lines.append(f"  {label:<14} median {np.median(values):8.4f}  worst {np.max(values):8.4f}")
        lines.append("  the worst:")
        lines += [f"    {o.line()}" for o in sorted(good, key=lambda o: -o.angle_deg)[:3]]
    return "\n".join(lines + [f"    {o.line()}" for o in found if not o.accepted])


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=12, help="photographs of each lens")
    parser.add_argument("--others", type=int, default=50, help="photographs with the scan of another room")
    parser.add_argument("--narrow", type=int, default=4, help="photographs of each lens with a scan of 120 deg")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--lens", choices=tuple(_WIDTH), action="append", help="only this lens")
    given = parser.parse_args()
    lenses: tuple[WideLens, ...] = tuple(given.lens or _WIDTH)
    groups: dict[str, list[Outcome]] = {}
    others: list[Outcome] = []
    share = -(-given.others // max(1, given.cases * len(lenses)))
    for lens in lenses:
        earlier: list[lr.Scan] = []
        for name, case in cases(lens, given.first, given.cases):
            groups.setdefault(lens, []).append(registered(name, case))
            print(groups[lens][-1].line(), flush=True)
            for scan in earlier[-share:]:
                if len(others) < given.others:
                    others.append(registered(f"{name} with {scan.name}", case, scan))
                    print(others[-1].line(), flush=True)
            earlier = [*earlier, case.scan][-share:]
        for name, case in cases(lens, given.first, given.narrow, narrow=True):
            groups.setdefault(f"{lens}, narrow scan", []).append(registered(name, case))
            print(groups[f"{lens}, narrow scan"][-1].line(), flush=True)
    print(f"\nbars: {_BARS}")
    for group, found in groups.items():
        print(f"\n{group}: {table(found)}")
    if others:
        wrong = [o for o in others if o.accepted]
        highest = max(o.fraction for o in others)
        print(f"\nother rooms: accepted {len(wrong)} of {len(others)}; most regions that agreed {highest:.0%}")
        for outcome in wrong:
            print(f"    {outcome.line()}")


if __name__ == "__main__":
    main()
