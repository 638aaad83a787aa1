"""Surveys: photographs solved together against one by one, with the error, the covariance and the verdict of each.

    python -m benchmarks.survey [--rooms 8] [--first-seed 100] [--photos 12] [--close-ups 4] [--alone] [--journal FILE]
    python -m benchmarks.survey --audit 50 [--first-seed 100]

Each room is scanned from two stations and photographed by two cameras whose stated focal lengths are 1 to 3 % wrong;
one photograph is of another room, and close-ups show parts at several times the scale. Errors are of the pose in the
frame of the first scanner: distance of the camera's centre, median displacement of the laser's points in the
photograph, and the Mahalanobis distance by the stated covariance / sqrt 6, whose root mean square is 1 where that is
right. `--alone` registers each photograph by itself, too. A journal keeps what was done, so that a run can go on.

`--audit` judges poses that are off by known rotations or displacements in random directions: how often each size is
called wrong, beside the power that the audit promises for that error; and right poses, of which one in twenty may be.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import ladarreg_core as lr
from ladarreg_core.camera import CameraModel
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.survey.adjustment import Adjustment
from ladarreg_core.survey.audit import power_of
from ladarreg_core.survey.least_squares.problem import moved_pose
from testing.scenes.survey_set import SurveySet, TakenPhoto, simulate_survey, write_survey_set

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
    asked = parser.parse_args()
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
