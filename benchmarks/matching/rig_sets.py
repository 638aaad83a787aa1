"""Rigs of five simulated pairs of a sparse lidar: from a guess and from none, photographs moved on, and swapped."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import get_args

import numpy as np

import ladarreg_core as lr
from benchmarks.matching.sparse_sets import NONE, RIGHT_PX, ROUGH, off_by
from benchmarks.pose.report import Bar, Section, number, table
from benchmarks.register import Row
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.simulate.outdoor_case import OutdoorCase, simulate_rig
from ladarreg_core.simulate.robot_lidar import LidarName

PAIRS = 5
_SWAPPED, _SHUFFLED = "two photos swapped", "all photos moved on"
_HOWS = (ROUGH, NONE, _SHUFFLED, _SWAPPED)
_MIN_RIGHT = 95
_SIGMAS = (0.8, 1.2)
_NOTE = (
    f"One scanner and camera in {PAIRS} places, streets and courtyards by turns, with one pose; right: accepted, and "
    f"the median displacement in the photos is at most {RIGHT_PX:g} px. The rough guess is 5 degrees and .3 m off. "
    "Where all photos are moved on by one pair, none belongs to its scan; where two are swapped, three still belong: a "
    "right pose may be accepted if the other two pairs are refused by name; a rig that uses one of them is wrong. "
    "Sigmas: the RMS error in the pose's own standard deviations. s: the processor's seconds for a rig."
)


def rig_rows(seeds: range) -> Iterator[Row]:
    """Rigs of every lidar, in every way."""
    for seed in seeds:
        for lidar in get_args(LidarName):
            cases = simulate_rig(lidar, pairs=PAIRS, seed=seed)
            for how in _HOWS:
                yield _row(lidar, how, seed, cases)


def _row(lidar: LidarName, how: str, seed: int, cases: Sequence[OutdoorCase]) -> Row:
    truth, photos = cases[0].camera_from_scanner, [case.photo for case in cases]
    strangers: tuple[str, ...] = ()
    if how == _SHUFFLED:
        photos, strangers = [*photos[1:], photos[0]], tuple(map(str, range(PAIRS)))
    elif how == _SWAPPED:
        first, second = (int(k) for k in np.random.default_rng([seed, 3]).choice(PAIRS, 2, replace=False))
        photos[first], photos[second] = photos[second], photos[first]
        strangers = (str(first), str(second))
    guess = off_by(truth, seed) if how == ROUGH or (how == _SHUFFLED and seed % 2) else None
    pairs = [lr.RigPair(str(k), case.scan, photo) for k, (case, photo) in enumerate(zip(cases, photos, strict=True))]
    begun = time.process_time()
    result = lr.register_rig(pairs, initial=guess, options=lr.RigOptions(seed=seed))
    seconds = time.process_time() - begun
    pose = result.camera_from_scanner
    if pose is None or how == _SHUFFLED:
        return Row("auto", "rigs", f"{lidar}, {how}", seed, result.accepted, np.inf, np.nan, np.nan, seconds)
    apart = np.concatenate([rotvec_from_rotation(truth.rotation @ pose.rotation.T), truth.centre - pose.centre])
    known = bool(np.isfinite(result.covariance).all())
    squared = float(apart @ np.linalg.solve(result.covariance, apart)) if known else np.nan
    off = np.inf if {*strangers} & {*result.used} else _median_px(cases, truth, pose)
    return Row(
        "auto", "rigs", f"{lidar}, {how}", seed, result.accepted, off, float(np.degrees(pose.angle_to(truth))),
        1e3 * pose.distance_to(truth), seconds, sigmas=float(np.sqrt(squared / 6)),
    )  # fmt: skip


def _median_px(cases: Sequence[OutdoorCase], truth: Rigid, pose: Rigid) -> float:
    off = []
    for case in cases:
        points = case.scan.points[case.scan.valid].astype(float)
        points = points[:: max(1, len(points) // 2000)]
        true = case.true_camera.project(truth @ points)
        seen = case.true_camera.contains(true)
        length = np.hypot(*(true[seen] - case.true_camera.project(pose @ points[seen])).T)
        off.append(np.where(np.isfinite(length), length, np.inf))
    return float(np.median(np.concatenate(off)))


def rig_section(rows: Sequence[Row]) -> Section | None:
    """Return the section of these rows."""
    rows = [row for row in rows if row.set_name == "rigs"]
    if not rows:
        return None
    cells, bars = [], []
    for how in (ROUGH, NONE, _SWAPPED):
        mine = [row for row in rows if row.what.endswith(how)]
        for lidar in dict.fromkeys(row.what.split(", ")[0] for row in mine):
            cells.append((f"{lidar}, {how}", *_cells([row for row in mine if row.what.startswith(f"{lidar},")])))
        if mine and how != _SWAPPED:
            right = [row for row in mine if _is_right(row)]
            sigmas = _rms_sigmas(right)
            bars += [
                Bar(f"rigs, {how}: right, %", 100 * len(right) / len(mine), least=_MIN_RIGHT),
                Bar(f"rigs, {how}: sigmas", sigmas, least=_SIGMAS[0]),
                Bar(f"rigs, {how}: sigmas, at most", sigmas, most=_SIGMAS[1]),
            ]
    shuffled = [row for row in rows if row.what.endswith(_SHUFFLED)]
    if shuffled:
        cells.append((_SHUFFLED, *_cells(shuffled)))
    bars.append(
        Bar("rigs: accepted and wrong", sum(row.accepted and not _is_right(row) for row in rows), most=0, digits=0)
    )
    heads = ("cases", "right", "wrong", "median px", "worst px", "deg", "mm", "sigmas", "s")
    return Section(
        "rigs", "Rigs of sparse lidars", _NOTE, (("", table(heads, cells)),), tuple(bars), {"sets": ["rigs"]}
    )


def _is_right(row: Row) -> bool:
    return row.accepted and row.error_px <= RIGHT_PX


def _rms_sigmas(rows: Sequence[Row]) -> float:
    return float(np.sqrt(np.mean([row.sigmas**2 for row in rows]))) if rows else float("nan")


def _cells(rows: Sequence[Row]) -> tuple[str, ...]:
    right = [row for row in rows if _is_right(row)]
    wrong = sum(row.accepted for row in rows) - len(right)

    def over(name: str, digits: int = 2, worst: bool = False) -> str:
        values = [getattr(row, name) for row in right]
        return number(float((max if worst else np.median)(values)), digits) if values else "-"

    return (
        str(len(rows)), str(len(right)), str(wrong), over("error_px"), over("error_px", worst=True),
        over("error_deg", 3), over("error_mm", 1), number(_rms_sigmas(right)),
        number(float(np.median([row.seconds for row in rows])), 1),
    )  # fmt: skip
