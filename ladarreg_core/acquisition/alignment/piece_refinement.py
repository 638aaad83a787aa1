"""Refinement of the pieces of a mosaic against each other: from the unit's angles to what their overlaps show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.adjustment import (
    GATES,
    Adjustment,
    Common,
    RangeView,
    adjoint,
    adjust,
    move_between,
    off_planes,
    planes_of,
)
from ladarreg_core.acquisition.alignment.intensity_links import BLUR_CELLS, Link, link_equations, links_of
from ladarreg_core.acquisition.alignment.intensity_view import IntensityView, common_floor
from ladarreg_core.acquisition.alignment.light_search import search_turn, turned
from ladarreg_core.acquisition.alignment.mosaic_piece import PlacedPiece
from ladarreg_core.acquisition.alignment.piece_findings import knocked_pieces
from ladarreg_core.acquisition.alignment.refined_pieces import (
    PARAMETERS,
    RefinedPiece,
    Refinement,
    State,
    against_all,
    calibrated_mount,
    judged,
    kept,
)
from ladarreg_core.acquisition.alignment.run_faults import blow, fault_of_run, together
from ladarreg_core.acquisition.alignment.voxel_planes import dots
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.foundations.progress import Progress, Report, part_of
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_window import GridWindow
from ladarreg_core.scanner.grids import TabulatedGrid
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose

_SIGMA_ANGLE_RAD = float(np.radians(0.3))  # prior of pan and of tilt
_SIGMA_ROLL_RAD = float(np.radians(0.005))  # prior of the turn about the axis ahead, which the unit does not move
_SIGMA_SHIFT_M = 1e-4  # prior of each coordinate: the axes cross in one point
_SIGMA_MOUNT = (0.1, float(np.radians(5.0)))  # m and rad, prior of the correction of a given mount
_SIGMA_KNOCKED = (0.02, float(np.radians(1.0)))  # m and rad, prior of a piece that was knocked
_SIGMA_FIXED_RAD = float(np.radians(0.01))  # prior of all turns where pieces are not to be refined
_POINTS_A_PIECE = 60_000
_MAX_POINTS = 2_000_000  # of all pieces
_MAX_CELLS = 10_000_000  # of all pieces
_MIN_CELLS = 40_000  # of a piece
_MIN_POINTS = 300  # of a piece that is refined
_UNDETERMINED_RAD = float(np.radians(0.1))  # standard deviation
_HELD_BY_RANGES_RAD = float(np.radians(0.015))  # standard deviation up to which a direction needs no search
_SEARCHED_LEVEL = 2  # index of `BLUR_CELLS`: the finest
_SEARCHES = 4  # at most
_CLEARLY_BETTER = 4.0  # difference of log-likelihoods
_MIN_WORTH = 0.01
_HELD_OUT = 4  # of so many blocks of the room one
_THINNED = 3  # of so many points one
_BESIDE = 4  # cells
_MOUNT_GATES = ((0.25, 12.0), (0.2, 10.0), (0.12, 6.0), (0.06, 4.0), (0.04, 3.0), (0.04, 3.0))


def refine_pieces(
    pieces: Sequence[PlacedPiece],
    positions: Sequence[PanTilt],
    *,
    mount: Rigid,
    calibrate_mount: bool = False,
    refine: bool = True,
    report: Report | None = None,
) -> Refinement:
    """Refine the pieces of a mosaic, or the mount of its scanner, or both, by the surfaces that pieces share.

    The gauge is the unit's: what turns all pieces alike is not determined by overlaps and stays as the angles say on
    the average. One plane in four is held out; unless these agree better afterwards, nothing is changed.

    Args:
        pieces: the pieces at their poses by the unit's angles and the mount.
        positions: position of the unit at each.
        mount: `unit_from_scanner`.
        calibrate_mount: adjust the mount, too.
        refine: adjust the pieces; without it their angles are taken to be exact but for .01 deg.
        report: receives the progress; may raise `Cancelled`.
    """
    views, light = _views(pieces, positions, exact=not refine, report=part_of(report, 0.0, 0.2))
    placed = [view.world_from_scan for view in views]
    enough = np.array([len(view.points) >= _MIN_POINTS for view in views])
    common = _mount_moves() if calibrate_mount else None
    gates = _MOUNT_GATES if calibrate_mount else GATES
    if enough.sum() < 2:
        return kept(pieces, mount, enough, "the pieces do not overlap: each stays where the unit's angles say")
    links = [link.anchored(light[0], placed) for link in links_of(light, placed, report=part_of(report, 0.2, 0.3))]

    worth = np.ones(len(pieces))

    thin = [link.every(_THINNED) for link in links]

    def intensities(poses: Sequence[Rigid], stage: int, keep: IntArray | None = None) -> tuple[FloatArray, FloatArray]:
        levels = light[: stage + 1]
        used = links if len(levels) == len(light) else thin  # coarse levels only lead there
        return link_equations(used, levels, poses, keep=keep, held_out=_HELD_OUT, worth=worth)

    def all_intensities(poses: Sequence[Rigid], _: int) -> tuple[FloatArray, FloatArray]:
        return intensities(poses, len(light))

    train = adjust(
        views, common=common, use_blocks=lambda block: ~_held(block),
        more=lambda poses, stage: intensities(poses, stage, np.arange(1, _HELD_OUT)), report=part_of(report, 0.3, 0.55),
        gates=gates,
    )  # fmt: skip
    before, after = _held_out(views, placed, train.poses)
    if not (np.isfinite(before) and after <= before):
        why = (
            "too few surfaces are seen by several pieces"
            if not np.isfinite(before)
            else f"surfaces left out would disagree by {1000 * after:.2f} mm instead of {1000 * before:.2f} mm"
        )
        return kept(pieces, mount, enough, f"nothing was refined: {why}", before, after)
    # The planes that were held out agree, and are used from here on.
    links = [link.anchored(light[0], train.poses) for link in links]
    found = adjust(
        views, common=common, more=all_intensities, report=part_of(report, 0.55, 0.7),
        gates=gates[-2:], start=train,
    )  # fmt: skip
    spread = np.zeros((len(pieces), 2))
    fault = fault_of_run(found, views, common) if refine else None
    notes = () if fault is None else (fault.sentence,)
    if fault is not None and fault.kind == "mount" and fault.is_large:
        return kept(pieces, mount, enough, f"nothing was refined: {fault.sentence}", before, after)
    if fault is not None and fault.kind != "mount":
        common = together(common, blow(fault.first, fault.kind))
        again = part_of(report, 0.7, 0.73)
        found = adjust(views, common=common, more=intensities, report=again, gates=gates[-3:], start=found)
    if refine:
        loose = knocked_pieces(*_corrections(found, positions), enough)
        if loose.any() and not loose.all():
            # What was knocked is no longer held by the unit; what only gave way to it comes back.
            views = [_loosened(view) if free else view for view, free in zip(views, loose, strict=True)]
            again = part_of(report, 0.73, 0.76)
            found = adjust(views, common=common, more=intensities, report=again, gates=gates, start=found)
        for number in range(_SEARCHES):
            begun = 0.76 + 0.2 * number / _SEARCHES
            some = part_of(report, begun, begun + 0.1 / _SEARCHES)
            aside, spread, likely = _searched(found, views, positions, links, light, some)
            if aside is None:
                worth = likely
                break
            found = adjust(
                views, common=common, more=all_intensities,
                report=part_of(report, begun + 0.1 / _SEARCHES, begun + 0.2 / _SEARCHES), gates=gates[-2:], start=aside,
            )  # fmt: skip
        if worth.min() < 1:
            # The likelihood over all turns is broader than the curvature at the best one promises.
            doubted = adjust(
                views, common=common, more=all_intensities,
                report=part_of(report, 0.96, 0.97), gates=gates[-1:], start=found, steps=1,
            )  # fmt: skip
            found = replace(found, covariance=doubted.covariance)
    held = _weak(found, positions, enough)
    if refine and held.all():
        why = "nothing was refined: too little in the overlaps shows how the pieces lie; the unit's angles stay"
        return kept(pieces, mount, enough, why, before, after)
    if refine and held.any():
        # What the surfaces do not hold is put back; the others are adjusted without it.
        fixed = [_fixed(view) if hold else view for view, hold in zip(views, held, strict=True)]
        links = [link for link in links if not (held[link.first] or held[link.second])]
        thin = [link.every(_THINNED) for link in links]
        found = adjust(fixed, common=common, more=intensities, report=part_of(report, 0.97, 1.0), gates=gates)
    made = _result(
        pieces, positions, views, found, mount, held, (before, after), refine=refine, calibrated=calibrate_mount
    )
    made = replace(made, reasons=(*notes, *made.reasons))
    return judged(made, spread, fault) if refine else made


def overlap_points(scans: Sequence[Scan], poses: Sequence[Rigid], number: int, *, most: int) -> NDArray[np.float32]:
    """Return points (N, 3) of a scan, in its own frame, in directions that another scan covers, too.

    Args:
        scans: all scans.
        poses: `world_from_scan` of each.
        number: the scan whose points are wanted.
        most: about so many points at most.
    """
    scan = scans[number]
    coarse, _ = scan.thinned(20_000)
    share = _covered(coarse.points.reshape(-1, 3), scans, poses, number).mean()
    if share == 0:
        return np.zeros((0, 3), np.float32)
    thin, _ = scan.thinned(max(20_000, int(most / share)))
    points = thin.points
    # Between cells that are all covered, or all not, the others are, too.
    some = points[::_BESIDE, ::_BESIDE]
    there = _covered(some.reshape(-1, 3), scans, poses, number).reshape(some.shape[:2]).astype(np.uint8)
    square = np.ones((3, 3), np.uint8)
    everywhere, somewhere = (
        np.kron(change(there, square), np.ones((_BESIDE, _BESIDE), np.uint8))[: thin.shape[0], : thin.shape[1]] > 0
        for change in (cv2.erode, cv2.dilate)
    )
    known = np.isfinite(points[..., 0])
    covered = everywhere & known
    unsure = known & somewhere & ~everywhere
    covered[unsure] = _covered(points[unsure], scans, poses, number)
    return np.asarray(points[covered], np.float32)


def _covered(points: FloatArray, scans: Sequence[Scan], poses: Sequence[Rigid], number: int) -> BoolArray:
    covered = np.zeros(len(points), np.bool_)
    world = poses[number] @ points
    axis = poses[number].rotation @ scans[number].mean_direction
    for k, (scan, pose) in enumerate(zip(scans, poses, strict=True)):
        if k == number or axis @ pose.rotation @ scan.mean_direction < -0.9:
            continue
        left = np.flatnonzero(~covered)
        local = pose.inverse @ world[left]
        with np.errstate(invalid="ignore"):
            near = local @ scan.mean_direction >= _least_along(scan) * np.sqrt(dots(local, local))
        left, local = left[near], local[near]
        with np.errstate(invalid="ignore"):
            cell = np.asarray(scan.geometry.cell_of(local))
            inside = (cell >= 0).all(axis=-1) & (cell <= np.array(scan.shape) - 1).all(axis=-1)
        covered[left[inside]] = True
    return covered


def _least_along(scan: Scan) -> float:
    """Return the cosine of the angle from a scan's mean direction beyond which it has no cells."""
    rays = scan.geometry.rays[:: max(1, scan.shape[0] // 50), :: max(1, scan.shape[1] // 50)]
    angle = float(np.arccos(np.clip((rays @ scan.mean_direction).min(), -1, 1)))
    return float(np.cos(min(1.1 * angle + 0.05, np.pi)))


def _views(
    pieces: Sequence[PlacedPiece], positions: Sequence[PanTilt], *, exact: bool, report: Report | None
) -> tuple[list[RangeView], list[list[IntensityView]]]:
    scans = []
    most_cells = max(_MAX_CELLS // max(len(pieces), 1), _MIN_CELLS)
    most_points = min(_POINTS_A_PIECE, _MAX_POINTS // max(len(pieces), 1))
    steps = len(pieces) * (2 + len(BLUR_CELLS))

    def reported(done: int, label: str) -> None:
        if report is not None:
            report(Progress(done, steps, label))

    for number, piece in enumerate(pieces):
        reported(number, "reading the pieces")
        scans.append(_small(piece.load(), most_cells))
    poses = [piece.world_from_scanner for piece in pieces]
    floor = common_floor(scans)
    views = []
    for k, at in enumerate(positions):
        reported(len(pieces) + k, "finding what pieces share")
        views.append(RangeView(overlap_points(scans, poses, k, most=most_points), poses[k], _prior(at, exact=exact)))
    light: list[list[IntensityView]] = []
    for blur in BLUR_CELLS:
        reported(len(pieces) * (2 + len(light)), "preparing the intensities")
        light.append([IntensityView.of(scan, floor, blur) for scan in scans])
    return views, light


def _small(scan: Scan, most_cells: int) -> Scan:
    """Return every n-th row and column of a scan, holding nothing of the rest."""
    thin, stride = scan.thinned(most_cells)
    geometry, whole = thin.geometry, scan.geometry
    if stride > 1 and isinstance(whole, TabulatedGrid):
        law = None if whole.law is None else GridWindow(whole.law, (0, 0), thin.shape, (stride, stride))
        geometry = TabulatedGrid(whole.table[::stride, ::stride], law)
    return replace(thin, geometry=geometry, ranges=thin.ranges.copy(), intensity=thin.intensity.copy(), color=None)


def _axes(at: PanTilt) -> NDArray[np.float64]:
    """Return the pan axis, the tilt axis (upward is positive) and the axis ahead, as rows (3, 3), in the world."""
    turn = rotation_about("z", at.pan_rad)
    return np.stack([[0.0, 0.0, 1.0], turn @ [0.0, -1.0, 0.0], turn @ [1.0, 0.0, 0.0]])


def _prior(at: PanTilt, *, exact: bool = False) -> NDArray[np.float64]:
    angle = _SIGMA_FIXED_RAD if exact else _SIGMA_ANGLE_RAD
    roll = _SIGMA_FIXED_RAD if exact else _SIGMA_ROLL_RAD
    axes = _axes(at)
    information = np.zeros((6, 6))
    information[:3, :3] = axes.T @ np.diag([angle**-2, angle**-2, roll**-2]) @ axes
    information[3:, 3:] = np.eye(3) / _SIGMA_SHIFT_M**2
    return information


def _fixed(view: RangeView) -> RangeView:
    """Return a view without points, which its prior holds where it is."""
    return RangeView(view.points[:0], view.world_from_scan, view.information)


def _loosened(view: RangeView) -> RangeView:
    """Return a view whose pose is hardly held by the unit."""
    return RangeView(
        view.points, view.world_from_scan, np.diag([_SIGMA_KNOCKED[1] ** -2] * 3 + [_SIGMA_KNOCKED[0] ** -2] * 3)
    )


def _corrections(found: Adjustment, positions: Sequence[PanTilt]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what each pose was moved from where its prior has it: turns (V, 3), deg, and shifts (V, 3), mm, in the
    scanner's frame.
    """
    turns = [np.degrees(_axes(at) @ move[:3]) for at, move in zip(positions, found.moved, strict=True)]
    shifts = [1000 * pose.rotation.T @ move[3:] for pose, move in zip(found.poses, found.moved, strict=True)]
    return np.array(turns), np.array(shifts)


def _mount_moves() -> Common:
    shift, angle = _SIGMA_MOUNT

    def moves(poses: Sequence[Rigid]) -> NDArray[np.float64]:
        # In the order of `PARAMETERS`: the shift first.
        return np.stack([np.hstack([adjoint(pose)[:, 3:], adjoint(pose)[:, :3]]) for pose in poses])

    return Common(moves, np.diag([shift**-2] * 3 + [angle**-2] * 3))


def _held(block: IntArray) -> BoolArray:
    return np.asarray(block % _HELD_OUT == 0, np.bool_)


def _held_out(views: Sequence[RangeView], before: Sequence[Rigid], after: Sequence[Rigid]) -> tuple[float, float]:
    """Return the RMS distances from held-out planes with both sets of poses; the planes are those that either joins."""
    squares, counts = np.zeros(2), 0
    for poses in (before, after):
        found, owner = planes_of(views, poses, apart_m=0.1, angle_rad=float(np.radians(5.0)))
        found = found.select(_held(found.block))
        if not found.count:
            continue
        for k, tried in enumerate((before, after)):
            squares[k] += float((_clipped(off_planes(views, tried, found, owner)) ** 2).sum())
        counts += len(found.point)
    if not counts:
        return float("nan"), float("nan")
    rms = np.sqrt(squares / counts)
    return float(rms[0]), float(rms[1])


def _clipped(distances: FloatArray) -> FloatArray:
    """Return distances of which outliers count as five typical ones."""
    limit = 5 * 1.4826 * float(np.median(np.abs(distances)))
    return np.clip(distances, -limit, limit)


def _searched(
    found: Adjustment,
    views: Sequence[RangeView],
    positions: Sequence[PanTilt],
    links: Sequence[Link],
    light: Sequence[Sequence[IntensityView]],
    report: Report | None,
) -> tuple[Adjustment | None, NDArray[np.float64], NDArray[np.float64]]:
    """Return an adjustment with the pieces that belong elsewhere put there, None if all are where they belong; how far
    each piece may be off in pan and tilt (V, 2), rad, as far as this was searched, one sigma; and the share (V,) of the
    information of its intensities that the search confirms.
    """
    spread, worth = np.zeros((len(positions), 2)), np.ones(len(positions))
    poses, moved = list(found.poses), found.moved.copy()
    any_moved = False
    for k, at in enumerate(positions):
        if report is not None:
            report(Progress(k, len(positions), "searching for weak pieces"))
        variance, along = np.linalg.eigh(np.linalg.inv(_pan_tilt(found.planes_data, k, at) + _angles_prior()))
        open_ = variance > _HELD_BY_RANGES_RAD**2
        if not open_.any() or len(views[k].points) < _MIN_POINTS:
            continue
        directions = along.T[open_] @ _axes(at)[:2]
        with_light = np.linalg.inv(_pan_tilt(found.data, k, at) + _angles_prior())
        stated = np.einsum("ia,ij,ja->a", along, with_light, along)[open_]
        best = search_turn(
            k, links, light[_SEARCHED_LEVEL], _SEARCHED_LEVEL, poses, directions, np.sqrt(variance[open_])
        )  # fmt: skip
        spread[k] = np.sqrt(np.square(best.spread[:, None] * along.T[open_]).sum(axis=0))
        promised, shown = (1 / one - 1 / variance[open_] for one in (stated, np.maximum(best.spread**2, stated)))
        worth[k] = np.clip(np.min(shown / np.maximum(promised, 1e-9)), _MIN_WORTH, 1.0)
        if best.gain > _CLEARLY_BETTER:
            turn = best.turn @ directions
            poses[k] = turned(poses[k], turn)
            moved[k, :3] += turn
            any_moved = True
    return (replace(found, poses=tuple(poses), moved=moved) if any_moved else None), spread, worth


def _pan_tilt(data: FloatArray, k: int, at: PanTilt) -> NDArray[np.float64]:
    """Return the information (2, 2) of a piece's pan and tilt, the other pieces fixed and the rest of it unknown."""
    own = data[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
    angles = np.zeros((6, 2))
    angles[:3] = _axes(at)[:2].T
    others = np.zeros((6, 4))
    others[:3, 0] = _axes(at)[2]
    others[3:, 1:] = np.eye(3)
    full = others.T @ (own + _prior(at)) @ others
    mixed = angles.T @ own @ others
    return np.asarray(angles.T @ own @ angles - mixed @ np.linalg.solve(full, mixed.T))


def _angles_prior() -> NDArray[np.float64]:
    return np.eye(2) / _SIGMA_ANGLE_RAD**2


def _weak(found: Adjustment, positions: Sequence[PanTilt], enough: BoolArray) -> BoolArray:
    """Return the pieces whose pan or tilt the surfaces do not hold, each with the others fixed."""
    weak = ~enough
    for k, at in enumerate(positions):
        seen = _pan_tilt(found.data, k, at)
        weak[k] |= bool(np.linalg.eigvalsh(seen)[0] < _UNDETERMINED_RAD**-2)
    return weak


def _result(
    pieces: Sequence[PlacedPiece],
    positions: Sequence[PanTilt],
    views: Sequence[RangeView],
    found: Adjustment,
    mount: Rigid,
    held: BoolArray,
    checked: tuple[float, float],
    *,
    refine: bool,
    calibrated: bool,
) -> Refinement:
    new_mount, covariance, reasons = mount, None, []
    if calibrated and found.common is not None and found.common_covariance is not None:
        new_mount, covariance = calibrated_mount(mount, found.common[:6], found.common_covariance[:6, :6])
        lost = [name for name, value in zip(PARAMETERS, np.diag(covariance), strict=True) if not np.isfinite(value)]
        if lost:
            reasons.append(f"not determined, kept as given: {', '.join(lost)} of the mount")
    out, turns = [], against_all(found.covariance)
    for k in range(len(pieces)):
        at = positions[k]
        by_unit = pan_tilt_pose(at.pan_rad, at.tilt_rad, unit_from_scanner=new_mount)
        pose = by_unit if held[k] or not refine else found.poses[k]
        move = move_between(by_unit, pose)
        sigma = np.degrees(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", _axes(at), turns[k], _axes(at)), 0)))
        turn = np.degrees(_axes(at) @ move[:3])
        state: State = "refined"
        if held[k]:
            state = "no overlap" if len(views[k].points) < _MIN_POINTS else "not determined"
        elif not refine:
            state = "kept"
        out.append(
            RefinedPiece(
                pose, state, (float(turn[0]), float(turn[1]), float(turn[2])),
                tuple(1000 * (pose.rotation.T @ move[3:])), (float(sigma[0]), float(sigma[1])), int(found.points[k]),
            )
        )  # fmt: skip
    unheld = [str(k) for k in np.flatnonzero(held)]
    if refine and unheld:
        reasons.append(
            f"the unit's angles stay for piece{'s' * (len(unheld) > 1)} {', '.join(unheld)}: too little overlap, or no "
            "surfaces in it that hold it"
        )
    after, owner = planes_of(views, [one.world_from_scanner for one in out], apart_m=0.1, angle_rad=0.09)
    noise = float("nan")
    if after.count:
        noise = float(np.sqrt(np.mean(_clipped(off_planes(views, found.poses, after, owner, within_views=True)) ** 2)))
    return Refinement(
        tuple(out), accepted=True, mount=new_mount, mount_covariance=covariance, held_out_before_m=checked[0],
        held_out_after_m=checked[1], noise_m=noise, planes=found.planes, reasons=tuple(reasons),
    )  # fmt: skip
