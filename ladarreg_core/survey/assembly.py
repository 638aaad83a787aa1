"""Puts together the result of a survey: of its scans, cameras and photographs, with their verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ladarreg_core.camera.uncertainty import INTRINSICS
from ladarreg_core.foundations.arrays import BoolArray
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.survey.adjustment import (
    AdjustedCamera,
    AdjustedLine,
    AdjustedPhoto,
    AdjustedScan,
    AdjustedSensor,
    AdjustedTie,
    Adjustment,
    SurveyEvidence,
    TieResidual,
    scan_covariance,
)
from ladarreg_core.survey.build import Bodies
from ladarreg_core.survey.least_squares.line_residuals import line_surface_residuals
from ladarreg_core.survey.least_squares.problem import Matrix, Problem, projected
from ladarreg_core.survey.least_squares.solver import LOST, Adjusted
from ladarreg_core.survey.parts import SurveyLine, SurveyTie
from ladarreg_core.survey.placement import Placement
from ladarreg_core.survey.rigs import Rigs
from ladarreg_core.survey.survey import Survey
from ladarreg_core.survey.ties.lines import MIN_PHOTOS, DrawnLine, start_or_reason
from ladarreg_core.survey.ties.ties import tracks_of
from ladarreg_core.survey.verdicts import Solution, agreeing_ties, agrees_with_scan, count_ties

_UNKNOWN = np.full((6, 6), np.nan)
_MAX_SHOWN = 60
_MAX_MARKS = 400  # ties of a photograph that are kept to be drawn


def adjustment_of(
    survey: Survey,
    placement: Placement,
    solution: Solution,
    refused: Mapping[int, tuple[str, ...]],
    *,
    rigs: Rigs,
    options: Mapping[str, Any],
    inputs: Mapping[str, Any],
) -> Adjustment:
    """Return the result of a survey.

    Args:
        survey: the survey.
        placement: what was found of its scans and photographs.
        solution: the adjustment of what was kept.
        refused: why photographs without a scan's evidence were not accepted, by their indices.
        rigs: what is known of the rigs.
        options: of the registrations, JSON-ready.
        inputs: name, size and SHA-256 of the files, by kind and id.
    """
    adjusted, bodies, states = solution.adjusted, solution.bodies, placement.states
    names = [one.given.id for one in states]
    scans = {given.id: _scan(placement, adjusted, bodies, k) for k, given in enumerate(survey.scans)}
    photos = {names[k]: _photo(survey, placement, solution, refused, k, names) for k in range(len(states))}
    placed = [(given.id, bodies.scans[k]) for k, given in enumerate(survey.scans) if bodies.scans[k] >= 0]
    order = [
        *(("scan", name, body) for name, body in placed),
        *(("photo", names[k], body) for k, body in sorted(bodies.photos.items())),
    ]
    joint = np.block([
        [adjusted.covariance_between(a, b) for *_, b in order] for *_, a in order
    ]) if order else np.zeros((0, 0))  # fmt: skip
    return Adjustment(
        scans=scans, cameras=_cameras(survey, adjusted, photos), photos=photos, chi2_per_dof=adjusted.chi2_per_dof,
        sigma_px=adjusted.sigma_px, joint=joint, joint_ids=tuple((kind, name) for kind, name, _ in order),
        residuals=_worst_ties(adjusted, bodies, names), rigs=_rigs(survey, rigs), options=options, inputs=inputs,
        ties=drawn_ties(survey.ties, solution, photos),
        lines=drawn_lines(survey.lines, placement.lines, solution, photos),
    )  # fmt: skip


def _scan(placement: Placement, adjusted: Adjusted, bodies: Bodies, scan: int) -> AdjustedScan:
    station, body = placement.stations.each[scan], bodies.scans[scan]
    if body < 0:
        return AdjustedScan(world_from_scanner=None, covariance=_UNKNOWN, fixed=False, reasons=station.reasons)
    return AdjustedScan(
        world_from_scanner=adjusted.problem.poses[body].inverse, covariance=scan_covariance(adjusted, body),
        fixed=station.fixed, reasons=station.reasons,
    )  # fmt: skip


def _photo(
    survey: Survey, placement: Placement, solution: Solution, refused: Mapping[int, tuple[str, ...]], k: int,
    names: list[str],
) -> AdjustedPhoto:  # fmt: skip
    adjusted, bodies, state = solution.adjusted, solution.bodies, placement.states[k]
    if k not in bodies.photos:
        taken = solution.taken_out.get(k)
        reasons = refused.get(k) or ((taken.reason,) if taken else state.reasons) or ("Nothing is known of it.",)
        return AdjustedPhoto(
            camera_from_world=None, covariance=_UNKNOWN, camera=state.camera, camera_id=state.given.camera,
            evidence="none", reasons=reasons,
            moved_others_sigmas=None if taken is None else taken.moved_others_sigmas,
        )  # fmt: skip
    body, ties = bodies.photos[k], count_ties(adjusted, bodies, k)
    scans = tuple(survey.scans[scan].id for scan in sorted(state.pairs) if agrees_with_scan(solution, k, scan))
    partners = tuple(names[one] for one in ties.partners)
    others = f"{len(partners)} other photograph{'' if len(partners) == 1 else 's'}"
    tied = f"{ties.agree} ties with {others} agree" if ties.agree else "it shares no ties"
    verified = {one for one in bodies.photos if placement.states[one].by_image}
    evidence: SurveyEvidence = "image" if state.by_image else "rig" if ties.reason_against(verified) else "ties"
    reason = {
        "image": f"The image of {' and of '.join(scans)} verifies it; {tied}.",
        "ties": f"No scan's image verifies it by itself; {tied}, and the colours of the surface verify it.",
        "rig": f"No scan's image verifies it; its rig holds it to a verified photograph of its frame; {tied}.",
    }[evidence]
    return AdjustedPhoto(
        camera_from_world=adjusted.problem.poses[body], covariance=adjusted.covariance_of(body),
        camera=adjusted.problem.camera_of(body), camera_id=state.given.camera,
        evidence=evidence, reasons=(reason,), scans=scans, ties=ties.agree,
        ties_left_out=ties.left_out, partners=partners, median_px=ties.median_px, tie_marks=_tie_marks(adjusted, body),
        sigma_px=_pixel_sigma(adjusted, body, _points_shown(placement, solution, k)),
    )  # fmt: skip


def _tie_marks(adjusted: Adjusted, body: int) -> Matrix:
    """Return where a photograph shows ties, see `AdjustedPhoto.tie_marks`."""
    agree = agreeing_ties(adjusted)
    counted = agree | ~adjusted.tie_inliers  # not those whose only partners were left out, as in `count_ties`
    seen = np.isfinite(adjusted.tie_residuals_px).all(axis=1)
    own = np.flatnonzero((adjusted.problem.ties.photo == body) & counted & seen)
    if len(own) > _MAX_MARKS:
        own = own[np.linspace(0, len(own) - 1, _MAX_MARKS).astype(int)]
    uv, off = adjusted.problem.ties.uv[own], adjusted.tie_residuals_px[own]
    return np.column_stack([uv, off, agree[own]]).astype(np.float64)


def drawn_ties(
    ties: Sequence[SurveyTie], solution: Solution, photos: Mapping[str, AdjustedPhoto]
) -> tuple[AdjustedTie, ...]:
    """Return of each tie that was drawn by hand whether it agrees, and why it does not.

    Args:
        ties: all that were drawn, in the order in which the adjustment numbers them.
        solution: the adjustment.
        photos: the results of all photographs in the order in which the adjustment numbers them, by id.
    """
    firsts = tracks_of([tuple(zip(one.photos, one.uv, strict=True)) for one in ties])
    return tuple(_drawn_tie(one, first, solution, photos) for one, first in zip(ties, firsts, strict=True))


def _drawn_tie(
    given: SurveyTie, first: int, solution: Solution, photos: Mapping[str, AdjustedPhoto]
) -> AdjustedTie:  # fmt: skip
    """Return whether a tie that was drawn by hand agrees, and why it does not; `first` is the number of its track."""
    adjusted = solution.adjusted

    def judged(reason: str, residual_px: float = float("nan"), *, agrees: bool = False) -> AdjustedTie:
        return AdjustedTie(id=given.id, photos=given.photos, agrees=agrees, residual_px=residual_px, reason=reason)

    refused = [word for word, name in zip(("first", "second"), given.photos, strict=True) if not photos[name].accepted]
    if refused:
        which = "both its photographs are" if len(refused) == 2 else f"its {refused[0]} photograph is"
        return judged(f"Left out: {which} not accepted.")
    ties = adjusted.problem.ties
    bodies = [body for name, body in zip(photos, _bodies(solution, len(photos)), strict=True) if name in given.photos]
    own = np.flatnonzero((ties.drawn[ties.point] == first) & np.isin(ties.photo, bodies))
    if len(own) < len(given.photos):
        return judged(
            "Left out: its two rays pass each other by far, or meet no surface and are nearly parallel; draw it again."
        )
    worst = float(np.nan_to_num(np.linalg.norm(adjusted.tie_residuals_px[own], axis=1), nan=np.inf).max())
    if adjusted.tie_inliers[own].all():
        return judged(f"It agrees within {worst:.1f} px.", worst, agrees=True)
    if not np.isfinite(worst):
        return judged("Left out: what it shows would lie behind one of the cameras; draw it again.")
    return judged(f"Left out: it lies {worst:.1f} px from where all other observations put it.", worst)


def drawn_lines(
    given: Sequence[SurveyLine], drawn: Sequence[DrawnLine], solution: Solution, photos: Mapping[str, AdjustedPhoto]
) -> tuple[AdjustedLine, ...]:
    """Return of each line that was drawn by hand whether it agrees, and why it does not.

    Args:
        given: all that were drawn.
        drawn: the same, as the adjustment numbers photographs and scans.
        solution: the adjustment.
        photos: the results of all photographs in the order in which the adjustment numbers them, by id.
    """
    return tuple(
        _drawn_line(one, number, drawn[number], solution, photos) for number, one in enumerate(given)
    )  # fmt: skip


def _drawn_line(
    given: SurveyLine, number: int, drawn: DrawnLine, solution: Solution, photos: Mapping[str, AdjustedPhoto]
) -> AdjustedLine:
    """Return whether a line that was drawn by hand agrees, and why it does not; `number` is its own."""
    adjusted, bodies = solution.adjusted, solution.bodies
    names = list(photos)
    taking = {photo: body for photo, body in bodies.photos.items() if photos[names[photo]].accepted}
    lines = adjusted.problem.lines
    of_body = {int(lines.photo[row]): row for row in np.flatnonzero(lines.drawn[lines.line] == number).tolist()}
    shown = [photo for photo in drawn.photos if photo in taking]
    rows = {photo: of_body[taking[photo]] for photo in shown if taking[photo] in of_body}
    off = {photo: float(np.abs(adjusted.line_residuals_px[row]).max()) for photo, row in rows.items()}

    in_scan = lines.drawn[lines.on_line] == number
    off_m = _off_in_scan(adjusted.problem, in_scan)

    def judged(reason: str, *, agrees: bool = False) -> AdjustedLine:
        residuals = tuple(off.get(photo, float("nan")) for photo in drawn.photos)
        return AdjustedLine(
            id=given.id, photos=given.photos, agrees=agrees, residuals_px=residuals, scan_residual_m=off_m,
            reason=reason,
        )  # fmt: skip

    if not rows:
        return judged(start_or_reason(adjusted.problem, drawn, taking, bodies.scans)[1])
    kept = [photo for photo, row in rows.items() if adjusted.line_inliers[row]]
    lost = [photo for photo in shown if photo not in kept]
    scan_kept = bool(in_scan.any() and (adjusted.line_surface_weights[in_scan] > LOST).all())
    worst = max((off[photo] for photo in lost if np.isfinite(off.get(photo, np.nan))), default=None)
    by = "" if worst is None else f" by {worst:.1f} px"
    if len(kept) < (1 if scan_kept else MIN_PHOTOS):
        which = ", ".join(given.photos)
        return judged(f"Left out: one of {which} shows another edge, or the line is off it{by}; draw it again.")
    if lost:
        left_out = " and ".join(names[photo] for photo in lost)
        return judged(f"Left out in {left_out}, where it disagrees with all other observations{by}.")
    if in_scan.any() and not scan_kept:
        return judged(f"Left out in the scan, which shows it elsewhere than its photographs by {format_length(off_m)}.")
    which = f"{len(kept)} photographs" if len(kept) > 1 else "one photograph"
    with_scan = " and the scan" if scan_kept else ""
    return judged(f"In {which}{with_scan} it agrees within {max(off.values()):.1f} px.", agrees=True)


def _off_in_scan(problem: Problem, of_line: BoolArray) -> float:
    """Return how far the places of a line in a scan lie from it, the larger of both, m; NaN: no scan shows it.

    Args:
        problem: the solved problem.
        of_line: which of the distances are of the line: along two directions across it, at one place after the other.
    """
    if not of_line.any():
        return float("nan")
    distance = line_surface_residuals(problem)[0][of_line]
    return float(np.linalg.norm(distance.reshape(-1, 2), axis=1).max())


def _bodies(solution: Solution, count: int) -> list[int]:
    """Return the bodies of the first photographs in the problem; -1: it has none."""
    return [solution.bodies.photos.get(photo, -1) for photo in range(count)]


def _rigs(survey: Survey, rigs: Rigs) -> dict[str, dict[str, AdjustedSensor]]:
    """Return the sensors of each rig relative to its first one."""
    found: dict[str, dict[str, AdjustedSensor]] = {}
    for rig, sensors in survey.rigs.items():
        reference, *_ = sensors
        found[rig] = {
            sensor: AdjustedSensor(
                reference_from_sensor=pair.first_from_second, covariance=pair.covariance, frames=pair.frames
            )
            for (name, first, sensor), pair in rigs.pairs.items()
            if name == rig and first == reference
        }
    return found


def _points_shown(placement: Placement, solution: Solution, photo: int) -> Matrix:
    """Return points (N, 3) of the world that a photograph shows: those that its scans' images agree on, or its ties."""
    adjusted, bodies, pairs = solution.adjusted, solution.bodies, placement.states[photo].pairs
    if not pairs:
        ties = adjusted.problem.ties
        own = (ties.photo == bodies.photos[photo]) & adjusted.tie_inliers
        return np.asarray(ties.points[ties.point[own]])
    return np.concatenate([
        adjusted.problem.poses[bodies.scans[scan]].inverse @ result.matches.points[result.inliers]
        for scan, result in pairs.items() if bodies.scans[scan] >= 0
    ] or [np.zeros((0, 3))])  # fmt: skip


def _pixel_sigma(adjusted: Adjusted, body: int, points: Matrix) -> float:
    """Return the median standard deviation of where a photograph shows points (N, 3) of the world, px."""
    _, by_pose, by_camera = projected(adjusted.problem, body, points)
    J = np.concatenate([by_pose, by_camera], axis=2)
    variance = np.einsum("nia,ab,nib->n", J, adjusted.pose_and_camera_covariance(body), J)
    known = variance[np.isfinite(variance)]
    return float(np.sqrt(np.median(known))) if len(known) else float("nan")


def _cameras(survey: Survey, adjusted: Adjusted, photos: Mapping[str, AdjustedPhoto]) -> dict[str, AdjustedCamera]:
    found = {}
    for k, given in enumerate(survey.cameras):
        own = [one for one in survey.photos if one.camera == given.id]
        taken = tuple(one.id for one in own if photos[one.id].accepted)
        unknowns = adjusted.problem.cameras[k]
        shown = photos[taken[0]].camera if taken else unknowns.base
        found[given.id] = AdjustedCamera(
            camera=shown, names=INTRINSICS if unknowns.size else (), covariance=adjusted.camera_covariance(k),
            photos=taken,
        )  # fmt: skip
    return found


def _worst_ties(adjusted: Adjusted, bodies: Bodies, names: list[str]) -> tuple[TieResidual, ...]:
    """Return the ties with the largest residuals, largest first."""
    ties, residual = adjusted.problem.ties, adjusted.tie_residuals_px
    length = np.nan_to_num(np.linalg.norm(residual, axis=1), nan=np.inf)
    photo_of, found, seen = bodies.photo_of, [], set()
    for k in np.argsort(-length, kind="stable").tolist():
        point = int(ties.point[k])
        if point in seen or not np.isfinite(length[k]):
            continue
        seen.add(point)
        rows = np.flatnonzero(ties.point == point)
        found.append(
            TieResidual(
                photos=tuple(names[photo_of[body]] for body in ties.photo[rows].tolist()), uv=ties.uv[rows],
                residual_px=residual[rows],
            )
        )  # fmt: skip
        if len(found) == _MAX_SHOWN:
            break
    return tuple(found)
