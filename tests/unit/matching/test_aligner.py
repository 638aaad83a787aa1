"""Direct alignment on a small painted room: refinement converges to the true pose, and the agreement confirms it."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import scan_levels
from ladarreg_core.matching.refine.aligner import Aligner, flow_step
from ladarreg_core.matching.refine.covariance import window_evidence
from ladarreg_core.matching.verify.agreement import agreement
from ladarreg_core.matching.verify.verification import GateOptions, verify
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import PaintedRoom, painted_room


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=1)


@pytest.fixture(scope="module")
def aligner(room: PaintedRoom) -> Aligner:
    working = working_camera(room.scan, room.photo.camera)
    view = perspective_view(room.scan, working)
    return Aligner(scan_levels(room.scan, view), photo_levels(room.photo, working), gate=GateOptions(), seed=0)


def displaced(pose: Rigid, turn_deg: tuple[float, float, float], shift_m: tuple[float, float, float]) -> Rigid:
    return Rigid(rotation_from_rotvec(np.deg2rad(turn_deg)) @ pose.rotation, pose.translation + np.array(shift_m))


STARTS = {
    "turned": ((0.6, -0.8, 0.5), (0, 0, 0)),
    "shifted": ((0, 0, 0), (0.05, -0.03, 0.08)),
    "both": ((-0.5, 0.6, -1.0), (-0.04, 0.04, 0.05)),
}


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
def test_refinement_converges_to_the_true_pose(room: PaintedRoom, aligner: Aligner, start: str) -> None:
    candidate = aligner.refine(displaced(room.camera_from_scanner, *STARTS[start]))
    assert candidate is not None
    pose = aligner.finish(candidate.camera_from_scanner)
    assert room.error_px(pose) < 0.35
    verification, _, _ = aligner.verify(pose)
    assert verification.accepted, verification.reasons


@pytest.mark.parametrize("turn_deg", [(0.0, 0.45, 0.0), (0.45, 0.0, 0.0), (0.3, -0.35, 0.3)])
def test_a_pose_a_few_pixels_off_is_refused(
    room: PaintedRoom, aligner: Aligner, turn_deg: tuple[float, float, float]
) -> None:
    pose = displaced(room.camera_from_scanner, turn_deg, (0, 0, 0))
    assert room.error_px(pose) > 2.5
    verification, _, _ = aligner.verify(pose)
    assert not verification.accepted
    assert verification.reasons


def test_peaks_lie_at_the_displacement(room: PaintedRoom, aligner: Aligner) -> None:
    pixels = 3.0
    turn = np.rad2deg(pixels / room.photo.camera.fx)
    maps = aligner.agreement_at(displaced(room.camera_from_scanner, (0, turn, 0), (0, 0, 0)), 0)
    shift, _, border = maps.peaks()
    # Turning the camera's frame by +y moves the prediction by +u, so the photo is found 3 px to the left.
    assert np.abs(np.median(shift[~border], axis=0) - [-pixels, 0]).max() < 0.4


def test_the_flow_step_reduces_the_error(room: PaintedRoom, aligner: Aligner) -> None:
    off = displaced(room.camera_from_scanner, (0.3, 0.35, -0.3), (0.02, 0, 0))
    maps = aligner.agreement_at(off, 1)
    pulled = flow_step(aligner.points[1], aligner.targets[1], maps, seed=0)
    assert pulled is not None
    assert room.error_px(pulled) < 0.5 * room.error_px(off)


def test_maps_are_normalised_correlation(room: PaintedRoom, aligner: Aligner) -> None:
    points, target = aligner.points[2], aligner.targets[2]
    maps = agreement(points, target, aligner.occluder, room.camera_from_scanner, level=2, radius=2)
    blocks = {tuple(cell): k for k, cell in enumerate(points.blocks.grid.tolist())}
    window = int(np.argmax(maps.pooled_blocks))
    row, column = maps.grid[window]
    pooled = np.zeros((5, 5))
    for block in [blocks.get((row + i, column + j)) for i in (-1, 0, 1) for j in (-1, 0, 1)]:
        if block is None:
            continue
        mine = np.flatnonzero((points.blocks.of_point == block) & maps.visible)
        if len(mine) < 12:
            continue
        a = points.channels[mine] - points.channels[mine].mean(axis=0)
        rho = np.zeros((5, 5))
        for v in range(-2, 3):
            for u in range(-2, 3):
                at = np.rint(maps.uv[mine]).astype(int) + np.array([u, v])
                b = target.channels[at[:, 1], at[:, 0]]
                b = b - b.mean(axis=0)
                rho[v + 2, u + 2] = (a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum())
        pooled += rho - rho.mean()
    np.testing.assert_allclose(maps.maps[window], pooled, atol=1e-4)


def test_the_covariance_covers_the_error(room: PaintedRoom, aligner: Aligner) -> None:
    candidate = aligner.refine(room.camera_from_scanner)
    assert candidate is not None
    pose = aligner.finish(candidate.camera_from_scanner)
    _, _, fine = aligner.verify(pose)
    evidence = window_evidence(fine, aligner.verification_points, aligner.photo.cameras[0], room.photo.camera, pose)
    assert evidence.agreeing > 30
    assert evidence.scatter_px < 1.5
    assert room.mahalanobis(pose, evidence.covariance) < 3
    assert np.linalg.eigvalsh(evidence.covariance).min() > 0


def test_too_few_windows_are_refused(room: PaintedRoom, aligner: Aligner) -> None:
    maps = aligner.agreement_at(room.camera_from_scanner, 1)
    few = type(maps)(
        maps.level, maps.radius, maps.maps[:20], maps.grid[:20], maps.pooled_blocks[:20], maps.members[:20],
        maps.uv, maps.visible,
    )  # fmt: skip
    assert verify(maps, None).accepted
    assert not verify(few, None).accepted
