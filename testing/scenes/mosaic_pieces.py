"""Pieces of a mosaic of the box room, as a scanner on a pan/tilt unit would measure them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ladarreg_core.acquisition.alignment.mosaic_piece import PlacedPiece
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, ScanGeometry
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose
from testing.scenes.box_room import distances

STEP_RAD = float(np.radians(0.5))
PIECE = AzimuthElevation(71, 101, STEP_RAD, STEP_RAD)
MOUNT = Rigid.from_rotvec([0.01, -0.02, 0.015], [0.06, -0.03, 0.08])


def where(points: FloatArray) -> FloatArray:
    """Return an intensity that says where: 300 + x + 10 y + 100 z."""
    return np.asarray(300 + points @ [1.0, 10.0, 100.0])


def piece_scan(
    pose: Rigid, geometry: ScanGeometry = PIECE, *, sigma_m: float = 0.0, seed: int = 0,
    light: Callable[[FloatArray], FloatArray] = where,
) -> Scan:  # fmt: skip
    """Return what a scanner at a pose measures; the intensity is that of the places (..., 3) in the world."""
    rays = geometry.rays @ pose.rotation.T
    true = distances(pose.translation, rays)
    points = pose.translation + rays * true[..., None]
    noise = sigma_m * np.random.default_rng(seed).standard_normal(true.shape)
    return Scan(geometry, (true + noise).astype(np.float32), light(points).astype(np.float32))


def placed(scan: Scan, pose: Rigid, name: str = "piece") -> PlacedPiece:
    """Return a piece that is in memory."""
    return PlacedPiece(lambda: scan, pose, name)


def mosaic(
    pans_deg: Sequence[float], tilts_deg: Sequence[float], *, mount: Rigid = MOUNT,
    geometry: ScanGeometry = PIECE, sigma_m: float = 0.0, off_rad: float = 0.0, seed: int = 0,
) -> tuple[list[PlacedPiece], list[Rigid]]:  # fmt: skip
    """Return the pieces of a mosaic where the unit says they are, off by `off_rad`, and their true poses."""
    rng = np.random.default_rng(seed)
    pieces, truth = [], []
    for tilt in np.radians(tilts_deg):
        for pan in np.radians(pans_deg):
            number = len(pieces)
            pose = pan_tilt_pose(pan, tilt, unit_from_scanner=mount)
            scan = piece_scan(pose, geometry, sigma_m=sigma_m, seed=1000 * seed + number)
            off = off_rad * rng.standard_normal(2)
            said = pan_tilt_pose(pan + off[0], tilt + off[1], unit_from_scanner=mount)
            pieces.append(placed(scan, said, f"piece {number}"))
            truth.append(pose)
    return pieces, truth
