"""Mosaics: pieces refined against each other, and a panorama of 28 million cells composed, registered and textured.

A double wall is measured where two pieces overlap: the distance between the surfaces that both show in patches of the
panorama's cells, each flat within one piece. Errors of pan and tilt are counted in their stated standard deviations.

Row `refinement` times 12 pieces of 360 x 256 cells, by the law of their scanner or with a tabulated ray for each cell,
as in most files, and with the mount given or estimated.

Run it as `python -m benchmarks.acquisition.mosaic [mosaic] [refinement] [large] [--seeds N] [--cells M]`.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.shared.bars import Row
from ladarreg_core.acquisition.alignment.mosaic_piece import LoadedPiece, PlacedPiece
from ladarreg_core.acquisition.alignment.piece_refinement import refine_pieces
from ladarreg_core.acquisition.alignment.refined_pieces import Refinement
from ladarreg_core.acquisition.composition.panorama_grid import footprint_of, grid_around
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.simulated.recordings import simulate_mosaic
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_about, rotvec_from_rotation
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid, TabulatedGrid
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose

_PIECES = (7, 4)
"""Columns and rows of the large mosaic."""
_OVERLAP = 0.08
_SEEDS, _QUICK_SEEDS = 20, 2
_PATCHES, _PATCH_CELLS = 3000, 16
_SMALL_PIECE = AzimuthElevation(256, 360, float(np.radians(55 / 360)), float(np.radians(38.5 / 256)))
_MOUNT_OFF = Rigid.from_rotvec(np.radians([0.2, -0.15, 0.1]), [0.008, -0.005, 0.01])
_FLAT_M, _SAME_M = 0.006, 0.05


def mosaic(*, seeds: Sequence[int] = range(3), scene: str = "office") -> list[dict[str, Any]]:
    """Return for each seed how far 4 x 3 pieces are from the truth before and after they are refined."""
    rows = []
    for seed in seeds:
        made = simulate_mosaic(scene, seed)
        mount = made.bench.frame_mount
        truth = [piece.world_from_scanner for piece in made.pieces]
        pieces = [
            PlacedPiece(
                (lambda scan=piece.scan: scan),
                pan_tilt_pose(piece.read.pan_rad, piece.read.tilt_rad, unit_from_scanner=mount),
                piece.scan.name,
            )
            for piece in made.pieces
        ]
        started = time.perf_counter()
        found = refine_pieces(pieces, [piece.read for piece in made.pieces], mount=mount)
        seconds = time.perf_counter() - started
        before = errors([piece.world_from_scanner for piece in pieces], truth)
        strong = [not piece.weak for piece in found.pieces]
        after = errors([piece.world_from_scanner for piece in found.pieces], truth, strong)
        moved = [
            replace(piece, world_from_scanner=one.world_from_scanner)
            for piece, one in zip(pieces, found.pieces, strict=True)
        ]
        rows.append({
            "scene": scene, "seed": seed, "seconds": seconds, "accepted": found.accepted,
            "refined": sum(piece.state == "refined" for piece in found.pieces),
            "before_deg": before[0], "after_deg_median": after[1], "after_deg": after[0], "after_mm": after[2],
            "held_out_before_mm": 1000 * found.held_out_before_m, "held_out_after_mm": 1000 * found.held_out_after_m,
            "noise_mm": 1000 * found.noise_m, "weak": [k for k, piece in enumerate(found.pieces) if piece.weak],
            "rms_in_sigmas": in_sigmas(found, truth, [piece.read for piece in made.pieces]),
            "walls_before_mm": double_walls(pieces), "walls_after_mm": double_walls(moved),
        })  # fmt: skip
    return rows


def refinement(*, seed: int = 0, scene: str = "office") -> list[dict[str, Any]]:
    """Return how long it takes to refine 12 pieces of 360 x 256 cells, and how far apart reports of progress are."""
    made = simulate_mosaic(scene, seed, geometry=_SMALL_PIECE)
    read = [piece.read for piece in made.pieces]
    truth = [piece.world_from_scanner for piece in made.pieces]
    rows = []
    for tables in (False, True):
        for calibrate in (False, True):
            mount = made.bench.frame_mount @ _MOUNT_OFF if calibrate else made.bench.frame_mount
            # A grid of its own each time, since what finds the cells of its rays is kept with it.
            scans = [
                replace(piece.scan, geometry=TabulatedGrid(piece.scan.geometry.rays)) if tables else piece.scan
                for piece in made.pieces
            ]
            pieces = [
                PlacedPiece(
                    (lambda scan=scan: scan), pan_tilt_pose(at.pan_rad, at.tilt_rad, unit_from_scanner=mount), scan.name
                )
                for scan, at in zip(scans, read, strict=True)
            ]
            reported = [started := time.perf_counter()]
            found = refine_pieces(
                pieces, read, mount=mount, calibrate_mount=calibrate,
                report=lambda _, reported=reported: reported.append(time.perf_counter()),
            )  # fmt: skip
            reported.append(time.perf_counter())
            strong = [not piece.weak for piece in found.pieces]
            rows.append({
                "tables": tables, "calibrate_mount": calibrate, "seconds": reported[-1] - started,
                "longest_silence_s": float(np.diff(reported).max()), "reports": len(reported) - 2,
                "accepted": found.accepted,
                "after_deg_median": errors([one.world_from_scanner for one in found.pieces], truth, strong)[1],
            })  # fmt: skip
    return rows


def refinement_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """Measure how long it takes to refine small pieces."""
    found = refinement()
    for one in found:
        show(json.dumps(one))
    rows = []
    for one in found:
        how = ", tabulated rays" * one["tables"] + ", mount estimated" * one["calibrate_mount"]
        what = f"12 pieces of 360 x 256{how}"
        rows.append(Row(f"{what}: refined in", "<= 30 s", f"{one['seconds']:.1f} s", one["seconds"] <= 30))
    silence = max(one["longest_silence_s"] for one in found)
    rows.append(Row("longest time between two reports of progress", "<= 5 s", f"{silence:.1f} s", silence <= 5))
    return rows


def in_sigmas(found: Refinement, truth: Sequence[Rigid], read: Sequence[PanTilt]) -> float:
    """Return the RMS error of pan and tilt of the refined pieces in their stated standard deviations."""
    strong = [not piece.weak for piece in found.pieces]
    poses = _without_gauge([piece.world_from_scanner for piece in found.pieces], truth, strong)
    shares = []
    for piece, pose, true, at in zip(found.pieces, poses, truth, read, strict=True):
        if piece.state != "refined":
            continue
        turn = np.degrees(rotvec_from_rotation(pose.rotation @ true.rotation.T))
        tilt_axis = rotation_about("z", at.pan_rad) @ [0.0, -1.0, 0.0]
        shares += [turn[2] / piece.sigma_deg[0], tilt_axis @ turn / piece.sigma_deg[1]]
    return float(np.sqrt(np.mean(np.square(shares)))) if shares else float("nan")


def double_walls(pieces: Sequence[PlacedPiece], *, seed: int = 0) -> float:
    """Return how far apart (mm) the surfaces of two pieces are in 95 % of the flat patches that both show."""
    footprints = [footprint_of(piece.load(), piece.world_from_scanner) for piece in pieces]
    grid = grid_around(footprints)
    loaded = [LoadedPiece(piece.load(), piece.world_from_scanner, grid) for piece in pieces]
    rng = np.random.default_rng(seed)
    side = np.arange(_PATCH_CELLS)
    apart = []
    for first in rng.integers(0, np.array(grid.shape) - _PATCH_CELLS, (_PATCHES, 2)):
        cells = np.stack(np.meshgrid(*(start + side for start in first), indexing="ij"), axis=-1).reshape(-1, 2)
        rays = grid.ray_at(cells)
        seen = []
        for piece, footprint in zip(loaded, footprints, strict=True):
            if footprint.may_show(rays.astype(np.float32)):
                ranges = piece.seen(rays.astype(np.float32), cells.astype(np.float32)).ranges
                if np.isfinite(ranges).all():
                    seen.append(rays * ranges[:, None])
        for k, points in enumerate(seen):
            centre = points.mean(axis=0)
            spread, axes = np.linalg.eigh(np.cov((points - centre).T))
            if spread[0] > _FLAT_M**2:
                continue
            gaps = [float(np.mean((other - centre) @ axes[:, 0])) for other in seen[k + 1 :]]
            apart += [abs(gap) for gap in gaps if abs(gap) < _SAME_M]
    return 1000 * float(np.quantile(apart, 0.95)) if apart else float("nan")


def errors(
    poses: Sequence[Rigid], truth: Sequence[Rigid], strong: Sequence[bool] | None = None
) -> tuple[float, float, float]:
    """Return the largest and the median angle (deg) and the largest distance (mm) of poses from the truth.

    What turns all pieces alike is no error of a mosaic: it is the gauge, and removed, as those show it that are held
    well.
    """
    turned = _without_gauge(poses, truth, strong)
    angles: FloatArray = np.degrees([one.angle_to(true) for one, true in zip(turned, truth, strict=True)])
    apart = max(float(np.linalg.norm(a.translation - b.translation)) for a, b in zip(turned, truth, strict=True))
    return float(angles.max()), float(np.median(angles)), 1000 * apart


def _without_gauge(poses: Sequence[Rigid], truth: Sequence[Rigid], strong: Sequence[bool] | None = None) -> list[Rigid]:
    use = np.ones(len(poses), bool) if strong is None or not any(strong) else np.array(strong)
    turns = [true.rotation @ pose.rotation.T for pose, true, good in zip(poses, truth, use, strict=True) if good]
    u, _, vt = np.linalg.svd(np.sum(turns, axis=0))
    return [Rigid(u @ vt, np.zeros(3)) @ pose for pose in poses]


def large(*, cells_millions: Sequence[float] = (2.0, 7.0, 28.0)) -> list[dict[str, Any]]:
    """Return time and peak memory of composing, registering and texturing panoramas of several sizes, each alone."""
    rows = []
    for size in cells_millions:
        with tempfile.TemporaryDirectory() as folder:
            _make(Path(folder), size)
            rows.append(_in_child(Path(folder)))
    if len(rows) > 1:
        first, last = rows[0], rows[-1]
        grown = np.log(last["cells"] / first["cells"])
        last["exponent"] = float(np.log(last["seconds"] / first["seconds"]) / grown)
    return rows


def _make(folder: Path, millions: float) -> None:
    """Write a photograph, and the pieces of a mosaic of 7 x 4 with a list, into a folder."""
    from benchmarks.shared.dome import CAMERA, POSE, SCENE
    from ladarreg_core.formats.cameras.camera_file import write_camera
    from ladarreg_core.formats.parsing.json_file import write_json
    from ladarreg_core.formats.scans.npz import write_npz_panorama
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan
    from ladarreg_core.simulate.case import case_world, png_of
    from ladarreg_core.simulate.photograph import Lighting, take_photograph
    from ladarreg_core.simulate.ray_cast import RayCaster
    from ladarreg_core.simulate.terrestrial import scan_around

    world = case_world(SCENE, seed=0)
    caster = RayCaster(world.triangles)
    step = float(2 * np.pi / np.sqrt(millions * 1e6 * 7 / 4))
    pan_step, tilt_step = 2 * np.pi / _PIECES[0], np.radians(205.7) / _PIECES[1]
    shape = [round(side * (1 + _OVERLAP) / step) for side in (tilt_step * 0.95, pan_step)]
    lines = ["file,pan_deg,tilt_deg"]
    middle = (_PIECES[1] - 1) / 2
    for row in range(_PIECES[1]):
        latitude = (row - middle) * np.radians(44.0)
        for column in range(_PIECES[0]):
            pan = column * pan_step
            height = round(np.radians(46.0) / step)
            grid = SphericalGrid(height, shape[1], step, step, pan, latitude + step * (height - 1) / 2)
            ranges, light = scan_around(world, caster, grid, rng=np.random.default_rng([row, column]))
            # The piece's own frame is turned by the pan; its rows are those of the panorama, so that its tilt is 0.
            own = SphericalGrid(height, shape[1], step, step, 0.0, latitude + step * (height - 1) / 2)
            name = f"piece_{row}_{column}.npz"
            write_npz_panorama(folder / name, Scan(own, ranges, light))
            lines.append(f"{name},{np.degrees(pan)},0")
    (folder / "pieces.csv").write_text("\n".join(lines), encoding="utf-8")
    pixels = take_photograph(
        world, caster, CAMERA, POSE, lighting=Lighting(), rng=np.random.default_rng([0, 1]), noise=1.0
    )
    (folder / "photo.png").write_bytes(png_of(Photo(pixels=pixels, camera=CAMERA, name="photo")))
    write_camera(folder / "camera.json", CAMERA)
    write_json(folder / "truth.json", {"camera_from_scanner": POSE.matrix.tolist()})


def _in_child(folder: Path) -> dict[str, Any]:
    cores = sorted(os.sched_getaffinity(0))[:2]
    child = subprocess.run(
        [sys.executable, "-m", "benchmarks.acquisition.mosaic", "--child", str(folder)],
        check=True, stdout=subprocess.PIPE, text=True, preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )  # fmt: skip
    figures: dict[str, Any] = json.loads(child.stdout.splitlines()[-1])
    return figures


def chain(folder: Path) -> dict[str, Any]:
    """Compose, write, read, view, register and texture; return the figures of this process."""
    from ladarreg.process_resources import keep_heap_small

    import ladarreg_core as lr
    from ladarreg_core.acquisition.composition.panorama import compose, write_panorama
    from ladarreg_core.formats.documents.pose_file import read_pose
    from ladarreg_core.surface.texture.photo_model import ModelPhoto, photo_model
    from ladarreg_core.surface.texture.registered_texture import texture_scan

    keep_heap_small()
    told: list[float] = []
    stages: dict[str, float] = {}
    started = time.perf_counter()

    def done(name: str) -> None:
        stages[name] = round(time.perf_counter() - started - sum(stages.values()), 2)
        peaks[name] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)

    peaks: dict[str, int] = {}
    made = compose(folder / "pieces.csv", report=lambda _: told.append(time.perf_counter() - started))
    done("compose")
    write_panorama(folder / "out", made)
    del made
    done("write")
    scan = lr.read_scan(folder / "out" / "scan.npz")
    photo = lr.read_photo(folder / "photo.png", camera=folder / "camera.json")
    done("read")
    found = lr.register(scan, photo)
    done("register")
    pose, truth = found.camera_from_scanner, read_pose(folder / "truth.json")
    texture = texture_scan(scan, photo, pose, camera=found.camera, covariance=found.joint_covariance)
    done("texture")
    model = photo_model(scan, [ModelPhoto(photo.pixels, found.camera, pose, texture.labels)])
    done("model")
    return {
        "cells": scan.ranges.size, "seconds": time.perf_counter() - started,
        "stages_s": stages, "peaks_mb": peaks,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "accepted": found.accepted,
        "error_deg": float(np.degrees(pose.angle_to(truth))), "error_mm": 1000 * pose.distance_to(truth),
        "first_progress_s": told[0], "reports": len(told), "faces": model.faces,
    }  # fmt: skip


def mosaic_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """Measure mosaics of 4 x 3 pieces whose angles are off by .1 deg."""
    found = []
    for seed in range(_QUICK_SEEDS if quick else _SEEDS):
        found += mosaic(seeds=[seed])
        show(json.dumps(found[-1]))
    deg, mm = max(row["after_deg"] for row in found), max(row["after_mm"] for row in found)
    before = min(row["before_deg"] for row in found)
    walls, double = max(row["walls_after_mm"] for row in found), min(row["walls_before_mm"] for row in found)
    sigmas = float(np.sqrt(np.mean([row["rms_in_sigmas"] ** 2 for row in found])))
    return [
        Row("mosaic: direction of a piece, worst", "<= .01 deg", f"{deg:.4f} deg", deg <= 0.01),
        Row("mosaic: place of a piece, worst", "<= 2 mm", f"{mm:.2f} mm", mm <= 2),
        Row("mosaic: surfaces of two pieces apart, 95 %, worst seed", "<= 1 mm", f"{walls:.2f} mm", walls <= 1),
        Row("mosaic, control: the same without refinement, best seed", "> 1 mm", f"{double:.2f} mm", double > 1),
        Row("mosaic: error of pan and tilt, RMS in sigmas", ".9 to 1.1", f"{sigmas:.2f}", 0.9 <= sigmas <= 1.1),
        Row("mosaic, control: direction without refinement, least", "> .01 deg", f"{before:.3f} deg", before > 0.01),
    ]


def large_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """Measure panoramas of 2 to 28 million cells, composed, registered and textured."""
    found = []
    for millions in (2.0, 7.0) if quick else (2.0, 7.0, 28.0):
        found += large(cells_millions=[millions])
        show(json.dumps(found[-1]))
    first, last = found[0], found[-1]
    exponent = float(np.log(last["seconds"] / first["seconds"]) / np.log(last["cells"] / first["cells"]))
    size = f"{last['cells'] / 1e6:.1f} M cells"
    return [
        Row(f"{size}: time on 2 cores", "<= 120 s", f"{last['seconds']:.0f} s", last["seconds"] <= 120),
        Row(f"{size}: peak of memory", "<= 2000 MB", f"{last['peak_mb']:.0f} MB", last["peak_mb"] <= 2000),
        Row(f"{size}: photograph accepted", "yes", "yes" if last["accepted"] else "no", bool(last["accepted"])),
        Row("growth of the time with the cells, exponent", "<= 1.1", f"{exponent:.2f}", exponent <= 1.1),
    ]


ROWS = {"mosaic": mosaic_rows, "refinement": refinement_rows, "large": large_rows}
"""The rows of this module."""


def main() -> None:
    """Print the rows asked for, one JSON object a line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", help=f"of {sorted(ROWS)}; all by default")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cells", type=float, nargs="+", default=[2.0, 7.0, 28.0])
    parser.add_argument("--child", type=Path)
    given = parser.parse_args()
    asked = given.rows or [*ROWS]
    if given.child is not None:
        print(json.dumps(chain(given.child)))
        return
    if "mosaic" in asked:
        for row in mosaic(seeds=range(given.seeds)):
            print(json.dumps(row), flush=True)
    if "refinement" in asked:
        for row in refinement():
            print(json.dumps(row), flush=True)
    if "large" in asked:
        for row in large(cells_millions=given.cells):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
