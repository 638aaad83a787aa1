"""Rows of survey targets: placed by them, found, named, and networks of scans joined by them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.shared.bars import Row
from benchmarks.stations.shared import FIRST_SEED, SCENES, Show, pose_error, random_pose, rms
from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec, rotvec_from_rotation
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.target_names import name_targets
from ladarreg_core.registration.stations.target_pose import TargetNetwork, register_targets
from ladarreg_core.registration.stations.target_search import find_targets
from ladarreg_core.registration.stations.targets import fit_target
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.stations import scan_stations, station_room, with_plates, with_spheres


def targets_rows(quick: bool, show: Show) -> list[Row]:
    """Six spheres with surveyed coordinates around each station; then one is moved, and two names are exchanged."""
    count, radius, sigma_m = 10 if quick else 100, 0.0725, 0.001
    azimuth, elevation = np.radians(np.arange(40, -40, -0.1)), np.radians(np.arange(16, -16, -0.1))
    walls = 6.0 / (np.cos(elevation)[:, None] * np.cos(azimuth))
    ratios: list[float] = []
    found: list[dict[str, Any]] = []
    moved, exchanged = 0, 0
    for k in range(count):
        rng = np.random.default_rng([FIRST_SEED, 7, k])
        noise_m, pose = float(rng.uniform(0.001, 0.003)), random_pose(rng, rng.uniform(-2, 2, 2))
        bearings = np.radians(np.linspace(-33, 33, 6) + rng.uniform(-3, 3, 6))
        distances, heights = rng.uniform(2, 5, 6), rng.uniform(-0.2, 0.2, 6)
        own = distances[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings), heights])
        empty = Scan.from_grid(
            ranges=walls + rng.normal(0, noise_m, walls.shape), azimuth_rad=azimuth, elevation_rad=elevation
        )
        scan = with_spheres(empty, own, radius, noise_m=noise_m, seed=k)
        targets = {}
        for n, center in enumerate(own):
            row, column = np.unravel_index(np.argmax(scan.rays @ center), scan.shape)
            targets[f"S{n}"] = fit_target(scan, (int(row), int(column)), radius_m=radius)
            ratios.append(float(np.linalg.norm(targets[f"S{n}"].center - center)) / noise_m)
        coordinates = {f"S{n}": pose @ center + rng.normal(0, sigma_m, 3) for n, center in enumerate(own)}
        placed = register_targets(targets, coordinates, sigma_m=sigma_m)
        mm, deg, distance = pose_error(pose, placed.world_from_scanner, placed.covariance)
        found.append({"targets": k, "mm": mm, "deg": deg, "distances": [distance], "left_out": placed.left_out})
        show(json.dumps(found[-1]))
        away = coordinates | {"S2": coordinates["S2"] + 0.02 * _direction(rng)}
        moved += register_targets(targets, away, sigma_m=sigma_m).left_out == ("S2",)
        swapped = coordinates | {"S1": coordinates["S4"], "S4": coordinates["S1"]}
        exchanged += register_targets(targets, swapped, sigma_m=sigma_m).left_out == ("S1", "S4")
    middle, most = np.median(ratios), np.percentile(ratios, 95)
    return [
        Row("spheres: error of the center / range noise, median (95 %)", "<= .3", f"{middle:.2f} ({most:.2f})",
            bool(most <= 0.3)),
        Row("targets: Mahalanobis distance / sqrt 6 of the poses, RMS", ".9 to 1.2", f"{rms(found):.2f}",
            0.9 <= rms(found) <= 1.2),
        Row("targets: left out though right", "reported", f"{sum(bool(one['left_out']) for one in found)} of {count}",
            True),
        Row("one target moved by 20 mm: found", "all", f"{moved} of {count}", moved == count),
        Row("two names exchanged: found", "all", f"{exchanged} of {count}", exchanged == count),
    ]  # fmt: skip


def network_rows(quick: bool, show: Show) -> list[Row]:
    """Four stations that share spheres and no surface, every second network with coordinates; then one is moved."""
    count, radius, sigma_m = 3 if quick else 25, 0.0725, 0.001
    azimuth, elevation = np.radians(np.arange(180, -180, -0.15)), np.radians(np.arange(16, -16, -0.15))
    ratios: list[float] = []
    bounds: list[FloatArray] = []
    found: list[dict[str, Any]] = []
    blunders, elsewhere = 0, 0
    for k in range(count):
        rng = np.random.default_rng([FIRST_SEED, 10, k])
        places = _scattered(rng, 14)
        poses = [random_pose(rng, rng.uniform(-1.5, 1.5, 2)) for _ in range(4)]
        scans: dict[str, dict[str, SurveyTarget]] = {}
        for n, pose in enumerate(poses):
            noise_m = float(rng.uniform(0.001, 0.003))
            walls = float(rng.uniform(8, 12)) / np.cos(elevation)[:, None] + np.zeros(len(azimuth))
            empty = Scan.from_grid(
                ranges=walls + rng.normal(0, noise_m, walls.shape), azimuth_rad=azimuth, elevation_rad=elevation
            )
            seen = rng.choice(len(places), 9, replace=False)
            own = pose.inverse @ places[seen]
            scan = with_spheres(empty, own, radius, noise_m=noise_m, seed=4 * k + n)
            scans[f"scan {n}"] = {}
            for which, center in zip(seen, own, strict=True):
                row, column = np.unravel_index(np.argmax(scan.rays @ center), scan.shape)
                try:
                    target = fit_target(scan, (int(row), int(column)), radius_m=radius)
                except LadarregError:
                    continue  # another sphere is in front of it
                scans[f"scan {n}"][f"S{which}"] = target
                ratios.append(float(np.linalg.norm(target.center - center)) / noise_m)
                bounds.append(_bound(scan, center, radius))
        known = rng.choice(len(places), 5, replace=False) if k % 2 else ()
        coordinates = {f"S{n}": places[n] + rng.normal(0, sigma_m, 3) for n in known}
        world = Rigid.identity() if k % 2 else poses[0].inverse
        placed = register_targets(scans, coordinates, sigma_m=sigma_m)
        found.append({"network": k, "left_out": placed.left_out, "distances": _of_network(poses, placed, world)})
        show(json.dumps(found[-1] | {"mm": 1000 * _worst_m(poses, placed, world)}))
        which, name = "scan 2", str(rng.choice([n for n in scans["scan 2"] if n in placed.places]))
        target = scans[which][name]
        off = replace(target, center=target.center + 0.02 * _direction(rng))
        again = register_targets({**scans, which: {**scans[which], name: off}}, coordinates, sigma_m=sigma_m)
        blunders += (which, name) in again.left_out
        elsewhere += any(one != name for _, one in again.left_out)
    middle, most, stations = np.median(ratios), np.percentile(ratios, 95), 4 * count
    drawn = np.random.default_rng(FIRST_SEED).normal(size=(len(bounds), 3))
    least = np.linalg.norm(np.einsum("nij,nj->ni", bounds, drawn), axis=-1)
    return [
        Row(f"networks: error of the centers in {stations} stations, 2 to 9 m at .15 deg, / range noise, median (95 %)",
            "median <= .3", f"{middle:.2f} ({most:.2f})", bool(middle <= 0.3)),
        Row("networks: the least that ranges of whole cells allow (Cramer-Rao bound), median (95 %)", "reported",
            f"{np.median(least):.2f} ({np.percentile(least, 95):.2f})", True),
        Row("networks by targets: Mahalanobis distance of all poses / sqrt dof, RMS", ".9 to 1.1", f"{rms(found):.2f}",
            0.9 <= rms(found) <= 1.1),
        Row("networks: left out though right", "reported", f"{sum(bool(one['left_out']) for one in found)} of {count}",
            True),
        Row("networks: one sighting moved by 20 mm: found", "all", f"{blunders} of {count}", blunders == count),
        Row("networks: another target left out for it", "reported", f"{elsewhere} of {count}", True),
    ]  # fmt: skip


def levels_rows(quick: bool, show: Show) -> list[Row]:
    """Four scanners that an inclinometer has made level to .02 deg, joined by few targets and by many, with and without
    that."""
    count, level_deg = 10 if quick else 100, 0.02
    rows = []
    for targets, sigma_m in ((9, 0.001), (4, 0.001), (4, 0.003)):
        found: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
        tilts: dict[bool, list[float]] = {False: [], True: []}
        for k in range(count):
            rng = np.random.default_rng([FIRST_SEED, 15, targets, round(1e4 * sigma_m), k])
            places = np.column_stack([rng.uniform(-5, 5, (targets, 2)), rng.uniform(-0.5, 0.5, targets)])
            poses, scans = [], {}
            for n in range(4):
                lean = rotation_from_rotvec(np.append(rng.normal(0, np.radians(level_deg), 2), 0.0))
                turn = rotation_from_rotvec(np.array([0, 0, rng.uniform(-np.pi, np.pi)])) @ lean.T
                poses.append(Rigid(turn, np.append(rng.uniform(-1.5, 1.5, 2), rng.uniform(-0.2, 0.2))))
                seen = poses[n].inverse @ places + rng.normal(0, sigma_m, places.shape)
                scans[f"scan {n}"] = {
                    f"S{m}": SurveyTarget(center, sigma_m**2 * np.eye(3), 0.0725, sigma_m, 50, 0)
                    for m, center in enumerate(seen)
                }
            world = poses[0].inverse
            for is_used in found:
                placed = register_targets(scans, levels=dict.fromkeys(scans, level_deg) if is_used else {})
                found[is_used].append({"levels": k, "distances": _of_network(poses, placed, world)})
                turns = [
                    rotvec_from_rotation((world @ pose).rotation @ placed.world_from_scanner[name].rotation.T)
                    for pose, name in zip(poses[1:], list(scans)[1:], strict=True)
                ]
                up = world.rotation[:, 2]
                tilts[is_used] += [float(np.degrees(np.linalg.norm(turn - up * (up @ turn)))) for turn in turns]
        off = {is_used: float(np.sqrt(np.mean(np.square(tilts[is_used])))) for is_used in tilts}
        show(json.dumps({"levels": [targets, sigma_m], "tilt_deg": off[True], "without": off[False]}))
        ratios = rms(found[False]), rms(found[True])
        rows += [
            Row(f"levels of .02 deg, {targets} targets good to {1000 * sigma_m:.0f} mm: tilt error without, with (RMS)",
                "smaller", f"{off[False]:.3f}, {off[True]:.3f} deg", off[True] < off[False]),
            Row("the same: Mahalanobis distance / sqrt dof, RMS, without, with", ".9 to 1.1",
                f"{ratios[0]:.2f}, {ratios[1]:.2f}", all(0.9 <= ratio <= 1.1 for ratio in ratios)),
        ]  # fmt: skip
    return rows


def names_rows(quick: bool, show: Show) -> list[Row]:
    """Two to six scans with false targets, unnamed, every second network with coordinates; and look-alike layouts."""
    count = 12 if quick else 150
    wrong, refused, placed_wrong = 0, 0, 0
    found: list[dict[str, Any]] = []
    for k in range(count):
        rng = np.random.default_rng([FIRST_SEED, 11, k])
        places = _scattered(rng, int(rng.integers(8, 16)))
        poses = [random_pose(rng, rng.uniform(-3, 3, 2)) for _ in range(int(rng.integers(2, 7)))]
        sees = int(rng.integers(5, 10))
        scans: dict[str, list[SurveyTarget]] = {}
        truth: dict[int, int] = {}
        for n, pose in enumerate(poses):
            seen = rng.choice(len(places), min(sees, len(places)), replace=False)
            own = [_sighting(rng, pose.inverse @ places[which]) for which in seen]
            false = [_sighting(rng, place) for place in _scattered(rng, int(rng.integers(0, 9)))]
            truth |= {id(one): int(which) for one, which in zip(own, seen, strict=True)}
            listed = own + false
            scans[f"scan {n}"] = [listed[i] for i in rng.permutation(len(listed))]
        known = rng.choice(len(places), 6, replace=False) if k % 2 else ()
        coordinates = {f"S{n}": places[n] + rng.normal(0, 0.001, 3) for n in known}
        try:
            named = name_targets(scans, coordinates)
            placed = register_targets(named, coordinates)
        except LadarregError as error:
            refused += 1
            show(json.dumps({"names": k, "refused": str(error)}))
            continue
        which_of: dict[str, set[int]] = {}
        for own_names in named.values():
            for name, one in own_names.items():
                which_of.setdefault(name, set()).add(truth.get(id(one), -1))
        bad = [name for name, which in which_of.items()
               if len(which) > 1 or which == {-1} or (name in coordinates and which != {int(name[1:])})]  # fmt: skip
        world = Rigid.identity() if k % 2 else poses[0].inverse
        wrong, placed_wrong = wrong + bool(bad), placed_wrong + (_worst_m(poses, placed, world) > 0.03)
        found.append({"names": k, "wrong": bad, "distances": _of_network(poses, placed, world)})
        show(json.dumps(found[-1]))
    alike = 0
    for k in range(4 if quick else 40):
        rng = np.random.default_rng([FIRST_SEED, 12, k])
        step, long = rng.uniform(1.5, 4, 2), int(rng.integers(4, 7))
        grid = np.array([[step[0] * i, step[1] * j, 0.0] for i in range(long) for j in range(2)])
        pose = random_pose(rng, rng.uniform(-2, 2, 2))
        halves = {"a": [_sighting(rng, at) for at in grid[:-2]],
                  "b": [_sighting(rng, pose.inverse @ at) for at in grid[2:]]}  # fmt: skip
        try:
            off = _worst_m([Rigid.identity(), pose], register_targets(name_targets(halves)), Rigid.identity())
            alike += off > 0.03
        except LadarregError as error:
            show(json.dumps({"alike": k, "refused": str(error)}))
    return [
        Row("scans with false targets: networks with a wrong name", "0", f"{wrong} of {count}", wrong == 0),
        Row("scans with false targets: placed wrong", "0", f"{placed_wrong} of {count}", placed_wrong == 0),
        Row("scans with false targets: refused", "reported", f"{refused} of {count}", True),
        Row("named networks: Mahalanobis distance / sqrt dof, RMS", ".9 to 1.1", f"{rms(found):.2f}",
            0.9 <= rms(found) <= 1.1),
        Row("targets in rows that look alike: placed wrong", "0", f"{alike} of {4 if quick else 40}", alike == 0),
    ]  # fmt: skip


def _scattered(rng: np.random.Generator, count: int) -> FloatArray:
    """Return places (N, 3), m, 3.5 to 6.5 m from the middle and .6 m from each other."""
    places: list[FloatArray] = []
    while len(places) < count:
        bearing, away = rng.uniform(-np.pi, np.pi), rng.uniform(3.5, 6.5)
        place = np.array([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-0.5, 0.5)])
        if all(np.linalg.norm(place - other) > 0.6 for other in places):
            places.append(place)
    return np.array(places).reshape(-1, 3)


def _bound(scan: Scan, center: FloatArray, radius_m: float) -> FloatArray:
    """Return a root (3, 3) of the least covariance of a sphere's center by ranges of unit noise, from cells that lie on
    the sphere as a whole: those that its rim crosses range to what is behind, too."""
    rays = scan.rays[scan.rays @ center > np.linalg.norm(center) * np.cos(2 * radius_m / np.linalg.norm(center))]
    along = rays.astype(np.float64) @ center
    apart = np.linalg.norm(rays * along[:, None] - center, axis=-1)
    whole = radius_m - apart >= float(max(scan.geometry.step_rad)) * along
    root = np.sqrt(radius_m**2 - apart[whole] ** 2)
    derivatives = rays[whole] - (along[whole, None] * rays[whole] - center) / root[:, None]
    return np.asarray(np.linalg.cholesky(np.linalg.inv(derivatives.T @ derivatives)))


def _sighting(rng: np.random.Generator, center: FloatArray) -> SurveyTarget:
    """Return a sphere that is found beside its place by its stated errors, of .3 to 1.5 mm."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    covariance = axes @ np.diag(rng.uniform(0.0003, 0.0015, 3) ** 2) @ axes.T
    return SurveyTarget(rng.multivariate_normal(center, covariance), covariance, 0.0725, 0.001, 60, 0)


def _of_network(poses: Sequence[Rigid], placed: TargetNetwork, world: Rigid) -> list[float]:
    """Return the Mahalanobis distance of all free poses together, over the root of their unknowns."""
    errors = np.concatenate([
        np.concatenate([rotvec_from_rotation((world @ pose).rotation @ found.rotation.T),
                        (world @ pose).translation - found.translation])
        for pose, found in zip(poses, placed.world_from_scanner.values(), strict=True)
    ])  # fmt: skip
    free = np.diag(placed.covariance) > 0
    errors, covariance = errors[free], placed.covariance[np.ix_(free, free)]
    return [float(np.sqrt(errors @ np.linalg.solve(covariance, errors) / len(errors)))]


def _worst_m(poses: Sequence[Rigid], placed: TargetNetwork, world: Rigid) -> float:
    both = zip(poses, placed.world_from_scanner.values(), strict=True)
    return max((world @ pose).distance_to(found) for pose, found in both)


def found_rows(quick: bool, show: Show) -> list[Row]:
    """Six spheres in furnished rooms and halls, at least 8 cells across, found and named by their coordinates alone."""
    return _found("spheres", quick, show)


def found_plates_rows(quick: bool, show: Show) -> list[Row]:
    """The same with flat targets, at least 12 cells along a side, turned by up to 35 deg from facing the scanner."""
    return _found("flat targets", quick, show)


def _found(kind: str, quick: bool, show: Show) -> list[Row]:
    count, sigma_m, is_flat = 4 if quick else 20, 0.001, kind == "flat targets"
    put, seen, others, right, wrong = 0, 0, 0, 0, 0
    for k in range(count):
        rng = np.random.default_rng([FIRST_SEED, 13 if is_flat else 9, k])
        room = station_room((*SCENES, "hall")[k % 6], FIRST_SEED + (600 if is_flat else 500) + k)
        step = np.radians(rng.uniform(0.08, 0.25))
        size, pose = float(rng.choice([0.15, 0.2] if is_flat else [0.0725, 0.1])), random_pose(rng, [0, 0])
        (scan,) = scan_stations(room, [pose], seed=k, step_deg=float(np.degrees(step)))
        reach = size * np.sqrt(0.5) if is_flat else size
        own = _in_free_space(scan, reach, size / ((12 if is_flat else 4) * step), rng)
        noise_m = float(rng.uniform(0.001, 0.003))
        if is_flat:
            facing = np.array([_facing(center, rng) for center in own])
            beam_rad = float(rng.uniform(4e-4, 1.6e-3))
            scan = with_plates(scan, own, facing, size, noise_m=noise_m, beam_rad=beam_rad, seed=k)
        else:
            scan = with_spheres(scan, own, size, noise_m=noise_m, seed=k)
        found = find_targets(scan, side_m=size) if is_flat else find_targets(scan, radius_m=size)
        away = np.array([[np.linalg.norm(one.center - center) for one in found] for center in own])
        near = int((away.min(axis=1, initial=np.inf) < 0.01).sum())
        put, seen, others = put + len(own), seen + near, others + len(found) - near
        surveyed = {f"S{n}": pose @ center + rng.normal(0, sigma_m, 3) for n, center in enumerate(own)}
        mm = np.nan
        try:
            placed = register_targets(name_targets(found, surveyed, sigma_m=sigma_m), surveyed, sigma_m=sigma_m)
            mm, deg, _ = pose_error(pose, placed.world_from_scanner, placed.covariance)
            right, wrong = right + (mm < 5 and deg < 0.1), wrong + (mm > 30)
        except LadarregError as error:
            show(json.dumps({"found": k, "refused": str(error)}))
        missed = [float(np.linalg.norm(center)) for center, off in zip(own, away, strict=True)
                  if off.min(initial=np.inf) >= 0.01]  # fmt: skip
        show(json.dumps({"found": k, "kind": kind, "put": len(own), "seen": near, "others": len(found) - near, "mm": mm,
                         "missed_m": missed, "step_deg": float(np.degrees(step))}))  # fmt: skip
    return [
        Row(f"{kind} in rooms: found without picks", "reported", f"{seen} of {put}, and {others} others", True),
        Row(f"scanners placed by found {kind}, within 5 mm and .1 deg", "reported", f"{right} of {count}", True),
        Row(f"scanners placed by found {kind}: wrong", "0", f"{wrong}", wrong == 0),
    ]


def _in_free_space(scan: Scan, radius: float, most_m: float, rng: np.random.Generator) -> FloatArray:
    """Return six places (6, 3), m, before what a scan saw, where nothing within a radius hides a target."""
    found: list[FloatArray] = []
    while len(found) < 6:
        row = int(rng.integers(scan.shape[0] // 4, 2 * scan.shape[0] // 3))
        column = int(rng.integers(scan.shape[1]))
        behind = float(scan.ranges[row, column])
        distance = min(behind - float(rng.uniform(0.15, 1.5)), most_m, 8.0)
        center = scan.rays[row, column].astype(np.float64) * distance
        clear = np.isfinite(behind) and distance > max(1.0, 5 * radius)
        if clear and all(np.linalg.norm(center - other) > 0.5 for other in found):
            around = scan.rays @ (center / distance) > np.cos(1.5 * radius / distance)
            if np.nanmin(scan.ranges[around]) > distance + radius:
                found.append(center)
    return np.array(found)


def _facing(center: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the rotation vector (3,) of a plate there, turned at will, that faces a scanner within 35 deg."""
    bearing, height = np.arctan2(center[1], center[0]), np.arctan2(center[2], np.hypot(center[0], center[1]))
    toward = Rigid.from_rotvec([0.0, 0.0, bearing]) @ Rigid.from_rotvec([0.0, -height, 0.0])
    leaning = Rigid.from_rotvec([0.0, *rng.uniform(-0.43, 0.43, 2)]) @ Rigid.from_rotvec([rng.uniform(-3, 3), 0.0, 0.0])
    return rotvec_from_rotation((toward @ leaning).rotation)


def plates_rows(quick: bool, show: Show) -> list[Row]:
    """Flat targets of 15 cm, turned and tilted by up to 35 deg, 2-8 m away, with beams of 2 to 8 mm at 5 m."""
    count, side = 20 if quick else 200, 0.15
    azimuth = np.radians(np.arange(4, -4, -0.08))
    ratios: list[float] = []
    squares: list[float] = []
    refused = 0
    walls = np.full((len(azimuth), len(azimuth)), 12.0)
    for k in range(count):
        rng = np.random.default_rng([FIRST_SEED, 8, k])
        noise_m, distance = float(rng.uniform(0.001, 0.003)), float(rng.uniform(2, 8))
        center = distance * np.array([1.0, *rng.uniform(-0.015, 0.015, 2)])
        empty = Scan.from_grid(
            ranges=walls + rng.normal(0, noise_m, walls.shape), azimuth_rad=azimuth, elevation_rad=azimuth
        )
        turn = np.array([rng.uniform(-np.pi, np.pi), 0.0, 0.0]), np.array([0.0, *rng.uniform(-0.6, 0.6, 2)])
        facing = rotvec_from_rotation((Rigid.from_rotvec(turn[1]) @ Rigid.from_rotvec(turn[0])).rotation)
        scan = with_plates(
            empty, center[None], facing[None], side, noise_m=noise_m, beam_rad=float(rng.uniform(4e-4, 1.6e-3)), seed=k
        )
        off = center + np.array([0.0, *rng.uniform(-0.2, 0.2, 2)]) * side
        row, column = np.unravel_index(np.argmax(scan.rays @ (off / np.linalg.norm(off))), scan.shape)
        try:
            found = fit_target(scan, (int(row), int(column)), side_m=side)
        except LadarregError as error:
            refused += 1
            show(json.dumps({"plates": k, "refused": str(error)}))
            continue
        error_m = found.center - center
        ratios.append(float(np.linalg.norm(error_m)) / noise_m)
        squares.append(float(error_m @ np.linalg.solve(found.covariance, error_m)) / 3)
        show(json.dumps({"plates": k, "mm": 1000 * float(np.linalg.norm(error_m)), "m_at": distance}))
    middle, most, rms = np.median(ratios), np.percentile(ratios, 95), float(np.sqrt(np.mean(squares)))
    return [
        Row("flat targets: error of the middle / range noise, median (95 %)", "<= .3", f"{middle:.2f} ({most:.2f})",
            bool(most <= 0.3)),
        Row("flat targets: Mahalanobis distance / sqrt 3, RMS", ".8 to 1.2", f"{rms:.2f}", 0.8 <= rms <= 1.2),
        Row("flat targets refused", "reported", f"{refused} of {count}", True),
    ]  # fmt: skip


def _direction(rng: np.random.Generator) -> FloatArray:
    direction = rng.normal(size=3)
    return np.asarray(direction / np.linalg.norm(direction))
