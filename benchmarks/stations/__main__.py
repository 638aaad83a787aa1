"""Stations registered to each other by their ranges: accuracy, false acceptance, loops, and a peer.

Row `page_28m` is a panorama of 28 million cells in the page (benchmarks/page/panorama_page.py), `unit_camera` the mount
of a camera on a pan/tilt unit (benchmarks/acquisition/unit_camera.py).

Run it as `python -m benchmarks.stations [--quick] [ROW ...]`. The rooms and seeds are kept aside: none was used for
tuning.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.acquisition.unit_camera import unit_camera_rows
from benchmarks.page.panorama_page import page_rows
from benchmarks.shared.bars import Row, table
from benchmarks.stations.shared import FIRST_SEED, SCENES, Show, pose_error, random_pose, rms
from benchmarks.stations.targets import (
    found_plates_rows,
    found_rows,
    levels_rows,
    names_rows,
    network_rows,
    plates_rows,
    targets_rows,
)
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.stations.network import adjusted
from ladarreg_core.registration.stations.pair import prepare, register_pair, voxels_of
from ladarreg_core.registration.stations.registration import register_scans
from ladarreg_core.registration.stations.search import search
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.alike import alike_corridor, equal_rooms, rooms_with_doorway, symmetric_room
from ladarreg_core.simulate.stations import scan_stations, station_room


def stations_rows(quick: bool, show: Show) -> list[Row]:
    """Two stations 3 m apart, full turns and 60 to 120 degrees, and small_gicp from the same start."""
    found = [_two_stations(k, show, wide=True) for k in range(4 if quick else 20)]
    narrow = [_two_stations(k, show, wide=False) for k in range(4 if quick else 20)]
    accepted = [one for one in found if one["verdict"] == "verified"]
    some = [one for one in narrow if one["verdict"] == "verified"]
    mm, deg = (max((one[name] for one in accepted), default=np.nan) for name in ("mm", "deg"))
    part_mm, part_deg = (max((one[name] for one in some), default=np.nan) for name in ("mm", "deg"))
    rows = [
        Row("two stations, full turns: accepted", "all", f"{len(accepted)} of {len(found)}",
            len(accepted) == len(found)),
        Row("two stations: worst position", "<= 5 mm", f"{mm:.2f} mm", mm <= 5),
        Row("two stations: worst rotation", "<= .05 deg", f"{deg:.4f} deg", deg <= 0.05),
        Row("60 to 120 deg wide: accepted and wrong", "0", f"{sum(one['mm'] > 30 for one in some)} of {len(narrow)}",
            all(one["mm"] <= 30 for one in some)),
        Row("60 to 120 deg wide: accepted, worst", "<= 5 mm, .05 deg",
            f"{len(some)} of {len(narrow)}, {part_mm:.2f} mm, {part_deg:.4f} deg", part_mm <= 5 and part_deg <= 0.05),
        Row("Mahalanobis distance / sqrt 6 of the pairs, RMS", ".9 to 1.1", f"{rms(accepted):.2f}",
            0.9 <= rms(accepted) <= 1.1),
    ]  # fmt: skip
    if "peer_mm" in found[0]:
        worst = [max(one[f"peer_{unit}"] for one in found) for unit in ("mm", "deg")]
        middle = [float(np.median([one[f"peer_{unit}"] for one in found])) for unit in ("mm", "deg")]
        own = [float(np.median([one[unit] for one in accepted])) for unit in ("mm", "deg")]
        rows.append(
            Row(
                "small_gicp from the same start: median (worst); ours: median", "reported",
                f"{middle[0]:.2f} ({worst[0]:.1f}) mm, {middle[1]:.4f} ({worst[1]:.3f}) deg; "
                f"{own[0]:.2f} mm, {own[1]:.4f} deg", True,
            )
        )  # fmt: skip
    return rows


def different_rows(quick: bool, show: Show) -> list[Row]:
    """Pairs of different rooms: none may be accepted."""
    wrong, count = [], 10 if quick else 50
    for k in range(count):
        rng = np.random.default_rng([FIRST_SEED, 2, k])
        width = 360.0 if k % 3 else float(rng.uniform(60, 120))
        scans = []
        for which in range(2):
            scene = SCENES[int(rng.integers(5)) if k % 2 else k // 2 % 5]
            room = station_room(scene, FIRST_SEED + 100 + 2 * k + which)
            pose = random_pose(rng, rng.uniform(-0.6, 0.6, 2))
            scans += scan_stations(room, [pose], seed=k, step_deg=0.5, width_deg=width)
        wrong += _judged(f"different {k}", scans, None, show)
    return [Row("different rooms: accepted", "0", f"{len(wrong)} of {count}", not wrong)]


def halls_rows(quick: bool, show: Show) -> list[Row]:
    """Two stations in a hall of 30 x 18 x 7 m, 5 to 15 m apart, with .15 to .3 deg; and pairs of different halls."""
    found: list[dict[str, Any]] = []
    wrong: list[str] = []
    before: Scan | None = None
    for k in range(4 if quick else 40):
        rng = np.random.default_rng([FIRST_SEED, 6, k])
        room = station_room("hall", FIRST_SEED + 400 + k)
        apart, along = rng.uniform(5, 15), rng.uniform(-1.5, 1.5, 2)
        poses = [random_pose(rng, [-apart / 2, along[0]]), random_pose(rng, [apart / 2, along[1]])]
        scans = scan_stations(room, poses, seed=k, step_deg=float(rng.uniform(0.15, 0.3)))
        pair = register_pair(prepare(scans[0]), prepare(scans[1]))
        mm, deg, distance = pose_error(poses[0].inverse @ poses[1], pair.first_from_second, pair.covariance)
        found.append({"hall": k, "apart_m": apart, "verdict": pair.verdict, "mm": mm, "deg": deg,
                      "distances": [distance], "overlap": pair.evidence.overlap,
                      "contradicted": pair.evidence.contradicted})  # fmt: skip
        show(json.dumps(found[-1]))
        if before is not None:
            wrong += _judged(f"different halls {k}", [before, scans[1]], None, show)
        before = scans[0]
    accepted = [one for one in found if one["verdict"] == "verified"]
    right = [one for one in accepted if one["mm"] <= 5 and one["deg"] <= 0.05]
    return [
        Row("halls: verified within 5 mm, .05 deg", ">= 90 %", f"{len(right)} of {len(found)}",
            len(right) >= 0.9 * len(found)),
        Row("halls: verified and wrong", "0", f"{sum(one['mm'] > 30 for one in accepted)}",
            all(one["mm"] <= 30 for one in accepted)),
        Row("halls: Mahalanobis distance / sqrt 6, RMS", ".9 to 1.2", f"{rms(accepted):.2f}",
            0.9 <= rms(accepted) <= 1.2),
        Row("different halls: accepted", "0", f"{len(wrong)} of {len(found) - 1}", not wrong),
    ]  # fmt: skip


def doors_rows(quick: bool, show: Show) -> list[Row]:
    """Stations in two rooms that see each other's through a doorway only, .8 to 3 m before it, with .15 to .3 deg."""
    found: list[dict[str, Any]] = []
    for k in range(6 if quick else 30):
        rng = np.random.default_rng([FIRST_SEED, 9, k])
        room = rooms_with_doorway(FIRST_SEED + 600 + k)
        away, aside = rng.uniform(0.8, 3.0, 2), rng.uniform(-0.5, 0.5, 2)
        poses = [random_pose(rng, [-away[0], aside[0]]), random_pose(rng, [away[1], aside[1]])]
        scans = scan_stations(room, poses, seed=k, step_deg=float(rng.uniform(0.15, 0.3)))
        pair = register_pair(prepare(scans[0]), prepare(scans[1]))
        mm, deg, distance = pose_error(poses[0].inverse @ poses[1], pair.first_from_second, pair.covariance)
        found.append({"doorway": k, "away_m": away.round(2).tolist(), "verdict": pair.verdict, "mm": mm, "deg": deg,
                      "distances": [distance], "overlap": pair.evidence.overlap, "reasons": pair.reasons})  # fmt: skip
        show(json.dumps(found[-1]))
    accepted = [one for one in found if one["verdict"] == "verified"]
    right = [one for one in accepted if one["mm"] <= 5 and one["deg"] <= 0.05]
    kept = [one for one in found if one["verdict"] == "ambiguous"]
    return [
        Row("through a doorway: verified", "reported", f"{len(accepted)} of {len(found)}", True),
        Row("those within 5 mm, .05 deg", "all", f"{len(right)}", len(right) == len(accepted)),
        Row("not determined, and kept as ambiguous", "reported", f"{len(kept)}", True),
        Row("doorways: Mahalanobis distance / sqrt 6 of those verified, RMS", ".9 to 1.2", f"{rms(accepted):.2f}",
            0.9 <= rms(accepted) <= 1.2),
    ]  # fmt: skip


def alike_rows(quick: bool, show: Show) -> list[Row]:
    """Corridors of equal bays, equal rooms, symmetric rooms: none may be accepted wrongly."""
    wrong, count = [], 6 if quick else 20
    for k in range(count):
        rng = np.random.default_rng([FIRST_SEED, 3, k])
        seed, truth = FIRST_SEED + k, None
        poses = [random_pose(rng, [rng.uniform(-2, 0), 0.1]), random_pose(rng, [rng.uniform(1, 4), -0.2])]
        near = [random_pose(rng, [-0.4, 0.3]), random_pose(rng, [0.5, -0.3])]
        if k % 3 == 0:
            # The ends are out of its range, as in a long corridor.
            both = scan_stations(alike_corridor(seed), poses, seed=k, step_deg=0.5)
            scans = [replace(s, ranges=np.where(s.ranges > 6.5, np.nan, s.ranges).astype(np.float32)) for s in both]
            truth = poses[0].inverse @ poses[1]
        elif k % 3 == 1:
            rooms = equal_rooms(seed)
            scans = [
                scan_stations(room, [pose], seed=2 * k + n, step_deg=0.5)[0]
                for n, (room, pose) in enumerate(zip(rooms, near, strict=True))
            ]
        else:
            scans = scan_stations(symmetric_room(seed), near, seed=k, step_deg=0.5)
            truth = near[0].inverse @ near[1]
        wrong += _judged(f"alike {k}", scans, truth, show)
    return [Row("places that look alike: accepted wrongly", "0", f"{len(wrong)} of {count}", not wrong)]


def loop_rows(quick: bool, show: Show) -> list[Row]:
    """Five stations in a loop, adjusted together."""
    found = []
    for k in range(2 if quick else 20):
        rng = np.random.default_rng([FIRST_SEED, 4, k])
        room = station_room(SCENES[k % 4], FIRST_SEED + 300 + k)
        around = 2 * np.pi * np.arange(5) / 5 + rng.uniform(0, 1)
        poses = [random_pose(rng, 1.2 * np.array([np.cos(a), np.sin(a)])) for a in around]
        network = register_scans(scan_stations(room, poses, seed=k, step_deg=0.5))
        each = [
            pose_error(poses[0].inverse @ pose, one.world_from_scanner, one.covariance)
            for pose, one in zip(poses[1:], network.stations[1:], strict=True)
            if one.world_from_scanner is not None
        ]
        found.append({
            "loop": k, "registered": len(each), "verified": sum(pair.verified for pair in network.pairs),
            "mm": max((one[0] for one in each), default=np.nan), "deg": max((one[1] for one in each), default=np.nan),
            "distances": [one[2] for one in each],
            "closing_mm": max((loop.error_mm for loop in network.loops), default=np.nan),
        })  # fmt: skip
        show(json.dumps(found[-1]))
    mm, deg = max(one["mm"] for one in found), max(one["deg"] for one in found)
    rms = float(np.sqrt(np.mean(np.square([d for one in found for d in one["distances"]]))))
    whole = sum(one["registered"] == 4 for one in found)
    return [
        Row("loop of five: all registered", "all", f"{whole} of {len(found)}", whole == len(found)),
        Row("loop of five: worst station", "<= 4 mm, .03 deg", f"{mm:.2f} mm, {deg:.4f} deg", mm <= 4 and deg <= 0.03),
        Row("loop of five: Mahalanobis distance / sqrt 6, RMS", ".9 to 1.1", f"{rms:.2f}", 0.9 <= rms <= 1.1),
    ]


def covariance_rows(quick: bool, show: Show) -> list[Row]:
    """Stated precision against errors: pairs and loops of five on coarse scans, from poses known to a few mm."""
    rows = []
    for what, count in (("pairs", 2), ("loops of five", 5)):
        squares: list[float] = []
        for k in range(4 if quick else 20):
            rng = np.random.default_rng([FIRST_SEED, 5, count, k])
            room = station_room(SCENES[k % 5], FIRST_SEED + 400 + k)
            around = 2 * np.pi * np.arange(count) / count + rng.uniform(0, 2 * np.pi)
            reach = 1.5 if count == 2 else 1.2
            poses = [random_pose(rng, reach * np.array([np.cos(a), np.sin(a)])) for a in around]
            scans = scan_stations(room, poses, seed=k, step_deg=0.5)
            truth = {n: poses[0].inverse @ pose for n, pose in enumerate(poses)}
            near = {
                n: pose @ Rigid.from_rotvec(rng.normal(0, 5e-4, 3), rng.normal(0, 0.002, 3)) if n else pose
                for n, pose in truth.items()
            }
            prepared = [prepare(scan) for scan in scans]
            placed = adjusted({n: one.view.surfels.returns for n, one in enumerate(prepared)}, 0, near,
                              voxels_of(prepared))  # fmt: skip
            each = [pose_error(truth[n], *placed[n])[2] for n in range(1, count)]
            squares += list(np.square(each))
            show(json.dumps({"covariance": what, "seed": k, "distances": each}))
        rms = float(np.sqrt(np.mean(squares)))
        rows.append(
            Row(f"{what}: Mahalanobis distance / sqrt 6, RMS of 20", ".9 to 1.1", f"{rms:.2f}", 0.9 <= rms <= 1.1)
        )
    return rows


def _two_stations(k: int, show: Show, *, wide: bool) -> dict[str, Any]:
    rng = np.random.default_rng([FIRST_SEED, 1, k])
    room = station_room(SCENES[k % 5], FIRST_SEED + k)
    # Both stand in the open: nothing furnishes the way through the middle of every room.
    bearing = rng.uniform(-np.pi, np.pi)
    half = 1.5 * np.array([np.cos(bearing), np.sin(bearing)])
    yaw = rng.uniform(-np.pi, np.pi)
    turn = rng.uniform(-np.pi, np.pi) if wide else rng.uniform(-0.4, 0.4)
    poses = [random_pose(rng, -half, yaw), random_pose(rng, half, yaw + turn)]
    width = 360.0 if wide else float(rng.uniform(60, 120))
    scans = scan_stations(room, poses, seed=k, step_deg=0.35, width_deg=width)
    truth = poses[0].inverse @ poses[1]
    first, second = prepare(scans[0]), prepare(scans[1])
    pair = register_pair(first, second)
    mm, deg, distance = pose_error(truth, pair.first_from_second, pair.covariance)
    out = {"stations": k, "width_deg": width, "verdict": pair.verdict, "mm": mm, "deg": deg, "distances": [distance],
           "overlap": pair.evidence.overlap, "contradicted": pair.evidence.contradicted}  # fmt: skip
    if wide:
        start = search(first.view, second.view, keep=1)[0].first_from_second
        peer = _small_gicp(scans, start)
        if peer is not None:
            out["peer_mm"], out["peer_deg"], _ = pose_error(truth, peer, np.eye(6))
    show(json.dumps(out))
    return out


def _small_gicp(scans: Sequence[Scan], start: Rigid) -> Rigid | None:
    """Return what small_gicp makes of a start; None where it is not installed."""
    try:
        import small_gicp
    except ImportError:
        return None
    points = [scan.points[scan.valid].astype(np.float64) for scan in scans]
    found = small_gicp.align(
        points[0], points[1], init_T_target_source=start.matrix, registration_type="GICP",
        downsampling_resolution=0.05, max_correspondence_distance=0.5, num_threads=1,
    )  # fmt: skip
    return Rigid.from_matrix(found.T_target_source)


def _judged(name: str, scans: Sequence[Scan], truth: Rigid | None, show: Show) -> list[str]:
    """Return the name if the pair was accepted and is wrong."""
    pair = register_pair(prepare(scans[0]), prepare(scans[1]))
    right = truth is not None and pair.first_from_second.distance_to(truth) < 0.03
    show(json.dumps({
        "pair": name, "verdict": pair.verdict, "right": right, "overlap": pair.evidence.overlap,
        "contradicted": pair.evidence.contradicted,
    }))  # fmt: skip
    return [name] if pair.verified and not right else []


ROWS: dict[str, Callable[[bool, Show], list[Row]]] = {
    "stations": stations_rows, "different": different_rows, "alike": alike_rows, "halls": halls_rows,
    "doors": doors_rows,
    "loop": loop_rows,
    "covariance": covariance_rows,
    "targets": targets_rows,
    "network": network_rows,
    "levels": levels_rows,
    "names": names_rows,
    "plates": plates_rows,
    "found": found_rows,
    "found_plates": found_plates_rows,
    "unit_camera": unit_camera_rows,
    "page_28m": page_rows,
}  # fmt: skip
"""The rows of this module."""


def main() -> None:
    """Measure the rows asked for, and print them against their bars."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"some of {', '.join(ROWS)}; all if none is given")
    parser.add_argument("--quick", action="store_true", help="a few seeds only, and a smaller panorama")
    given = parser.parse_args()
    if unknown := [name for name in given.rows if name not in ROWS]:
        parser.error(f"there is no row {', '.join(unknown)}; use {', '.join(ROWS)}")
    measured: list[Row] = []
    for name in given.rows or ROWS:
        measured += ROWS[name](given.quick, lambda text: print(text, flush=True))
    print(table(measured))


if __name__ == "__main__":
    main()
