"""Surveys: photographs solved together against one by one, with the error, the covariance and the verdict of each.

    python -m benchmarks.survey [--rooms 8] [--first-seed 100] [--photos 12] [--close-ups 4] [--alone] [--journal FILE]
    python -m benchmarks.survey --audit 50 [--first-seed 100]
    python -m benchmarks.survey --lines 24 [--first-seed 100]

Each room is scanned from two stations and photographed by two cameras whose stated focal lengths are 1 to 3 % wrong;
one photograph is of another room, and close-ups show parts at several times the scale. Errors are of the pose in the
frame of the first scanner: distance of the camera's centre, median displacement of the laser's points in the
photograph, and the Mahalanobis distance by the stated covariance / sqrt 6, whose root mean square is 1 where that is
right. `--alone` registers each photograph by itself, too. A journal keeps what was done, so that a run can go on.

`--audit` judges poses that are off by known rotations or displacements in random directions: how often each size is
called wrong, beside the power that the audit promises for that error; and right poses, of which one in twenty may be.

`--lines` draws by hand: four photographs of a room at poses known to .3 degrees and 15 mm, three places that all of
them show, and three to six lines, all ends right to .5 px; adjusted without the lines, with them, and with the lines as
the scan shows them, too, right to 3 mm. Then one photograph shows another edge of one line, 8 to 30 px away.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import ladarreg_core as lr
from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, look_along, rotvec_from_rotation
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose
from ladarreg_core.survey.adjustment import Adjustment
from ladarreg_core.survey.audit import power_of
from ladarreg_core.survey.least_squares.problem import (
    WORLD,
    CameraUnknowns,
    PhotoView,
    Problem,
    RelativePose,
    Ties,
    moved_pose,
    pose_difference,
)
from ladarreg_core.survey.least_squares.solver import Adjusted, solve
from ladarreg_core.survey.ties.features import Features
from ladarreg_core.survey.ties.lines import DrawnLine, lines_between
from ladarreg_core.survey.ties.ties import laser_points, tie_points, with_drawn
from testing.scenes.shared_places import line_between, shown_by
from testing.scenes.survey_set import CAMERAS, SurveySet, TakenPhoto, simulate_survey, write_survey_set

SCENES = ("office", "boxes", "desk", "people")
_EVERY = 97  # of the scan's points, which are projected


def measured(
    found: SurveySet, one: TakenPhoto, pose: Rigid | None, camera: CameraModel, covariance: Any
) -> dict[str, float]:
    """Return the errors of a photograph; nothing of one that was not accepted."""
    if pose is None or one.camera_from_world is None:
        return {}
    truth, true_camera = found.in_first(one.camera_from_world), found.cameras[one.camera]
    off = np.concatenate([rotvec_from_rotation(truth.rotation @ pose.rotation.T), truth.centre - pose.centre])
    points = found.scans[0].points[found.scans[0].valid][::_EVERY].astype(np.float64)
    uv, true_uv = camera.project(pose @ points), true_camera.project(truth @ points)
    inside = true_camera.contains(true_uv)
    return {
        "mm": 1000 * float(np.linalg.norm(off[3:])),
        "deg": float(np.degrees(np.linalg.norm(off[:3]))),
        "sigma_mm": 1000 * float(np.sqrt(np.trace(covariance[3:, 3:]))),
        "px": float(np.nanmedian(np.linalg.norm(uv - true_uv, axis=1)[inside])),
        "mahalanobis": float(np.sqrt(off @ np.linalg.solve(covariance, off) / 6)),
    }


def together(found: SurveySet, result: Adjustment, seed: int) -> list[dict[str, Any]]:
    """Return a row for each photograph of an adjustment."""
    by_stem = {Path(one.name).stem: one for one in found.photos}
    rows = []
    for name, photo in result.photos.items():
        one = by_stem[Path(name).stem]
        errors = measured(found, one, photo.camera_from_world, photo.camera, photo.covariance)
        kind = "elsewhere" if one.camera_from_world is None else "close-up" if one.scale > 1 else "photo"
        rows.append({
            "seed": seed, "photo": name, "how": "together", "kind": kind, "accepted": photo.accepted,
            "evidence": photo.evidence, "ties": photo.ties, "reason": photo.reasons[0], **errors,
        })  # fmt: skip
    return rows


def alone(found: SurveySet, folder: Path, seed: int) -> list[dict[str, Any]]:
    """Return a row for each photograph, registered by itself on the first scan."""
    scan, channels, rows = lr.read_scan(folder / "station1.npz"), lr.Channels(), []
    for one in found.photos:
        result = lr.register(scan, lr.read_photo(folder / one.name), channels=channels)
        pose = result.camera_from_scanner if result.accepted else None
        kind = "elsewhere" if one.camera_from_world is None else "close-up" if one.scale > 1 else "photo"
        rows.append({
            "seed": seed, "photo": one.name, "how": "alone", "kind": kind, "accepted": bool(result.accepted),
            "evidence": result.evidence, **measured(found, one, pose, result.camera, result.covariance),
        })  # fmt: skip
    return rows


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the figures by how and what, as lines."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["how"], row["kind"], ""].append(row)
        if row["accepted"]:
            groups[row["how"], row["kind"], row["evidence"]].append(row)
    lines = []
    for (how, kind, evidence), of_group in sorted(groups.items()):
        good = [row for row in of_group if "mm" in row]
        wrong = sum(row["accepted"] for row in of_group) if kind == "elsewhere" else 0
        text = (
            f"{how:<9} {kind:<9} {evidence or 'all':<6} {sum(r['accepted'] for r in of_group):3} of {len(of_group):3}"
        )
        if kind == "elsewhere":
            text += f"; WRONGLY ACCEPTED: {wrong}"
        if good:
            mm, px, m = (np.array([row[key] for row in good]) for key in ("mm", "px", "mahalanobis"))
            text += (
                f"; {np.median(mm):6.2f} mm median, {mm.max():6.2f} worst; {np.median(px):.2f} / {px.max():.2f} px; "
                f"Mahalanobis rms {np.sqrt(np.mean(m**2)):.2f}, worst {m.max():.2f}, beyond 5: {int((m > 5).sum())}"
            )
        lines.append(text)
    return lines


AUDITED = (
    (0.0, 0.0),
    (0.02, 0.0),
    (0.1, 0.0),
    (0.5, 0.0),
    (2.0, 0.0),
    (0.0, 1.0),
    (0.0, 5.0),
    (0.0, 20.0),
    (0.0, 100.0),
)
"""Errors that are injected: degrees and millimetres."""


def audits(count: int, first_seed: int) -> list[str]:
    """Return a line for each size of an error: how often it was seen, and how often that was promised."""
    seen: dict[tuple[float, float], list[tuple[str, float]]] = {size: [] for size in AUDITED}
    for seed in range(first_seed, first_seed + count):
        case = lr.simulate_case(SCENES[seed % len(SCENES)], seed=seed)
        rng = np.random.default_rng([seed, 5])
        for degrees, millimetres in AUDITED:
            direction = rng.normal(0, 1, 3)
            direction /= np.linalg.norm(direction)
            error = np.concatenate([np.radians(degrees) * direction, millimetres / 1000 * direction])
            found = lr.audit(case.scan, case.photo, moved_pose(case.camera_from_scanner, error))
            promised = power_of(found.covariance, error) if found.corrected is not None else float("nan")
            seen[degrees, millimetres].append((found.outcome, promised))
    lines = []
    for (degrees, millimetres), outcomes in seen.items():
        wrong, unknown = (sum(one == what for one, _ in outcomes) for what in ("wrong", "undecidable"))
        promised, of = float(np.nanmean([power for _, power in outcomes])), len(outcomes)
        within = 2 * np.sqrt(promised * (1 - promised) / of)
        lines.append(
            f"{degrees:g} deg, {millimetres:g} mm: seen {wrong} of {of} ({wrong / of:.2f}; promised {promised:.2f} +- "
            f"{within:.2f}), undecidable {unknown}"
        )
    return lines


_WEAK = np.array([*[np.radians(0.3)] * 3, *[0.015] * 3])
_DRAWN_PX, _PLACES, _VIEWS = 0.5, 3, 4
_SIGMAS = (0.003, _DRAWN_PX)
"""Of lines in the scan, m, and in photographs, px."""
_OFF_PX = (8.0, 30.0)


@dataclass(frozen=True)
class DrawnRoom:
    """Four photographs of a room, and what was drawn in them."""

    scan: Scan
    camera: CameraModel
    truth: list[Rigid]
    start: list[Rigid]
    places: FloatArray
    """(n, 4, 2) px."""
    lines: list[DrawnLine]


def drawn_room(seed: int) -> DrawnRoom | None:
    """Return a room; None: its photographs share too little."""
    rng, camera = np.random.default_rng([seed, 61]), CAMERAS[seed % 2]
    stands = upright_pose(np.array([-0.9, -0.5, 0.0]), float(rng.uniform(-np.pi, np.pi)))
    (scan,) = scan_stations(station_room(SCENES[seed % len(SCENES)], seed), [stands], seed=seed, step_deg=0.5)
    points = scan.points[scan.valid][::20].astype(np.float64)
    target = points[rng.integers(len(points))]
    truth = []
    for _ in range(_VIEWS):
        centre = rng.uniform([-0.9, -0.9, -0.3], [0.9, 0.9, 0.3])
        truth.append(Rigid.from_centre(look_along(target - centre), centre))
    common = points[np.all([shown_by(scan, points, camera, pose) for pose in truth], axis=0)]
    if len(common) < 40:
        return None
    chosen = common[rng.choice(len(common), _PLACES, replace=False)]
    places = np.stack([camera.project(pose @ chosen) for pose in truth], axis=1)
    lines: list[DrawnLine] = []
    wanted = int(rng.integers(3, 7))
    for _ in range(500):
        drawn = line_between(common, [camera] * _VIEWS, truth, rng)
        if drawn is not None and len(lines) < wanted:
            xyz, uv = (one + rng.normal(0, sigma, one.shape) for one, sigma in zip(drawn, _SIGMAS, strict=True))
            lines.append(DrawnLine(tuple(range(_VIEWS)), uv, _DRAWN_PX, xyz=xyz, sigma_m=_SIGMAS[0]))
    if len(lines) < wanted:
        return None
    start = [moved_pose(pose, _WEAK * rng.normal(size=6)) for pose in truth]
    return DrawnRoom(scan, camera, truth, start, places + rng.normal(0, _DRAWN_PX, places.shape), lines)


def adjusted_room(room: DrawnRoom, lines: Sequence[DrawnLine]) -> Adjusted:
    """Return the adjustment of a room by its places and some lines, as a survey does it, twice."""
    none = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
    drawn = [((0, to), place[[0, to]], _DRAWN_PX) for place in room.places for to in range(1, _VIEWS)]
    features, matches, ends = with_drawn([none] * _VIEWS, {}, drawn)
    known = [RelativePose(k, WORLD, one, np.diag(_WEAK**2), name="prior") for k, one in enumerate(room.start, 1)]
    camera = CameraUnknowns(room.camera, np.zeros(0), np.zeros(0), np.zeros((0, 0)))
    views = (None, *(PhotoView(0, np.eye(4), np.zeros(4), room.camera) for _ in room.start))
    fixed = np.array([True, *[False] * _VIEWS])
    problem = Problem((Rigid.identity(), *room.start), fixed, views, (camera,), tuple(known), Ties.none())
    bodies = {k: k + 1 for k in range(_VIEWS)}
    for _ in range(2):
        poses = dict(enumerate(problem.poses[1:]))
        laser = {
            (k, 0): laser_points(room.scan, room.camera, pose, features[k].uv.astype(np.float64))
            for k, pose in poses.items()
        }
        ties = tie_points(
            matches, [one.uv for one in features], poses, dict.fromkeys(poses, room.camera), laser, [Rigid.identity()],
            body_of_scan=[0], body_of_photo=bodies, drawn=ends,
        )  # fmt: skip
        problem = replace(problem, ties=ties)
        found = solve(replace(problem, lines=lines_between(problem, lines, bodies, [0])))
        problem = found.problem
    return found


def lines_drawn(count: int, first_seed: int) -> list[str]:
    """Return the errors of poses without lines and with them, and how often a wrong one was named, as lines."""
    rows: dict[str, list[list[tuple[float, float, float]]]] = {
        "start": [], "places": [], "places and lines": [], "and in the scan": []
    }  # fmt: skip
    named, right_lost, right, moved, seed = 0, 0, 0, [], first_seed
    while len(rows["start"]) < count:
        room, seed = drawn_room(seed), seed + 1
        if room is None:
            continue
        truth = room.truth
        both, alone = adjusted_room(room, room.lines), adjusted_room(room, [])
        in_scan = adjusted_room(room, [replace(one, scan=0) for one in room.lines])
        of_start = [(np.diag(_WEAK**2), pose) for pose in room.start]
        rows["start"].append([_pose_errors(a, pose, cov) for a, (cov, pose) in zip(truth, of_start, strict=True)])
        for how, found in (("places", alone), ("places and lines", both), ("and in the scan", in_scan)):
            rows[how].append([
                _pose_errors(a, found.problem.poses[k], found.covariance_of(k)) for k, a in enumerate(truth, 1)
            ])  # fmt: skip
        print(f"room {seed - 1}: {len(room.lines)} lines", flush=True)
        rng = np.random.default_rng([seed, 62])
        wrong, photo = int(rng.integers(len(room.lines))), int(rng.integers(_VIEWS))
        bad = [replace(one, uv=one.uv.copy()) for one in room.lines]
        (u, v), (s, t) = bad[wrong].uv[photo]
        aside = np.array([t - v, u - s]) / np.hypot(t - v, u - s)
        bad[wrong].uv[photo] += rng.choice((-1, 1)) * rng.uniform(*_OFF_PX) * aside
        again = adjusted_room(room, bad)
        lines = again.problem.lines
        is_wrong = (lines.drawn[lines.line] == wrong) & (lines.photo == photo + 1)
        kept = again.line_inliers
        named += not (is_wrong & kept).any()
        right += int((~is_wrong).sum())
        right_lost += int((~kept & ~is_wrong).sum())
        moved.append(max(
            _pose_errors(both.problem.poses[k], again.problem.poses[k], both.covariance_of(k))[2]
            for k in range(1, _VIEWS + 1)
        ))  # fmt: skip
    said = []
    for how, of_rooms in rows.items():
        mm, deg, squared = np.array(of_rooms).transpose(2, 0, 1)
        chosen = np.random.default_rng(1).integers(0, count, (1000, count))
        spread = np.percentile(np.sqrt(np.mean(squared[chosen] ** 2, axis=(1, 2))), (2.5, 97.5))
        said.append(
            f"{how:<17} rms {np.sqrt(np.mean(mm**2)):5.1f} mm, {np.sqrt(np.mean(deg**2)):.3f} deg; Mahalanobis rms "
            f"{np.sqrt(np.mean(squared**2)):.2f} ({spread[0]:.2f} to {spread[1]:.2f}), worst {squared.max():.1f}"
        )
    said.append(
        f"a wrong edge in one of {_VIEWS} photographs: left out {named} of {count}; right ones left out {right_lost} "
        f"of {right}; poses moved by it, median {np.median(moved):.2f}, worst {max(moved):.2f} standard deviations"
    )
    return said


def _pose_errors(truth: Rigid, pose: Rigid, covariance: FloatArray) -> tuple[float, float, float]:
    """Return how far a pose lies off, mm and degrees, and its Mahalanobis distance / sqrt 6."""
    off = pose_difference(truth, pose)
    distance = np.sqrt(off @ np.linalg.solve(covariance, off) / 6)
    return 1000 * float(np.linalg.norm(off[3:])), float(np.degrees(np.linalg.norm(off[:3]))), float(distance)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--photos", type=int, default=12)
    parser.add_argument("--close-ups", type=int, default=4)
    parser.add_argument("--stations", type=int, default=2)
    parser.add_argument("--step-deg", type=float, default=0.2)
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--journal", type=Path)
    parser.add_argument("--audit", type=int, default=0)
    parser.add_argument("--lines", type=int, default=0)
    asked = parser.parse_args()
    if asked.lines:
        print("\n".join(lines_drawn(asked.lines, asked.first_seed)))
        return
    if asked.audit:
        print("\n".join(audits(asked.audit, asked.first_seed)))
        return
    rows: list[dict[str, Any]] = []
    if asked.journal is not None and asked.journal.exists():
        rows = [json.loads(line) for line in asked.journal.read_text(encoding="utf-8").splitlines()]
    done = {row["seed"] for row in rows}
    for seed in range(asked.first_seed, asked.first_seed + asked.rooms):
        if seed in done:
            continue
        found = simulate_survey(
            SCENES[seed % len(SCENES)], seed=seed, photos=asked.photos, close_ups=asked.close_ups,
            stations=asked.stations, step_deg=asked.step_deg,
        )  # fmt: skip
        with tempfile.TemporaryDirectory() as made:
            write_survey_set(Path(made), found)
            started = time.perf_counter()
            result = lr.adjust(lr.Survey.from_folder(made))
            new = together(found, result, seed)
            print(f"room {seed}: {time.perf_counter() - started:.0f} s", flush=True)
            if asked.alone:
                new += alone(found, Path(made), seed)
        rows += new
        if asked.journal is not None:
            with asked.journal.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(row) + "\n" for row in new)
        print("\n".join(f"  {line}" for line in table(new)), flush=True)
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
