"""Puts together the problem of a survey: from registrations, pooled cameras, stations, priors and ties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ladarreg_core.batches.photos.pooled_camera import CameraEstimate, camera_estimate, pool, pose_by_camera, turn_of
from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import CALIBRATED_CAMERA_PRIOR, DEFAULT_CAMERA_PRIOR, INTRINSICS
from ladarreg_core.frames import Rigid
from ladarreg_core.results.registration import Registration
from ladarreg_core.survey.least_squares.problem import (
    WORLD,
    CameraUnknowns,
    Matrix,
    PhotoView,
    Problem,
    RelativePose,
    Ties,
)
from ladarreg_core.survey.parts import SurveyCamera
from ladarreg_core.survey.placement import PhotoState, Placement
from ladarreg_core.survey.survey import Survey
from ladarreg_core.survey.ties.lines import DrawnLine, lines_between
from ladarreg_core.survey.ties.ties import tie_points

_KNOWN = 1e-6  # relative standard deviation of an intrinsic that is not estimated
_MAX_FROM_STATED = 3.0  # standard deviations of what was stated
_UNKNOWN_RAD = 1e3  # of a prior that states a position only
_WORLD_CAMERA = np.zeros(0)


@dataclass(slots=True, eq=False)
class Bodies:
    """Which scans and photographs are part of the problem, and where they stand in it."""

    scans: list[int]
    """Index of each scan's body, -1: not part of it."""
    photos: dict[int, int] = field(default_factory=dict)
    """Body of each photograph that is."""

    @property
    def photo_of(self) -> dict[int, int]:
        """Photograph of each body."""
        return {body: photo for photo, body in self.photos.items()}


def numbered_lines(survey: Survey) -> list[DrawnLine]:
    """Return the lines that were drawn, with the numbers of their photographs and scans."""
    photos = {one.id: k for k, one in enumerate(survey.photos)}
    scans = {one.id: k for k, one in enumerate(survey.scans)}
    found = []
    for one in survey.lines:
        drawn = DrawnLine(tuple(photos[name] for name in one.photos), np.array(one.uv), one.sigma_px)
        shown = one.in_scan
        if shown is not None:
            drawn = replace(drawn, scan=scans[shown.scan], xyz=np.array(shown.xyz), sigma_m=shown.sigma_m)
        found.append(drawn)
    return found


def camera_unknowns(survey: Survey, states: Sequence[PhotoState]) -> list[CameraUnknowns]:
    """Return the cameras of a survey as far as the registrations by themselves determine them.

    Each photograph's own estimate counts with the information of its images alone; the prior of the camera counts once.
    """
    found = []
    for camera in survey.cameras:
        own = [one for one in states if one.given.camera == camera.id]
        found.append(_unknowns(camera, own))
    return found


def build_problem(
    survey: Survey,
    placement: Placement,
    cameras: Sequence[CameraUnknowns],
    poses: Mapping[int, Rigid],
    relative: Mapping[tuple[int, int], RelativePose],
) -> tuple[Problem, Bodies]:
    """Return the problem without ties.

    Args:
        survey: the survey.
        placement: its photographs, scans and stations.
        cameras: the cameras and their priors.
        poses: `camera_from_world` of the photographs that take part.
        relative: what scans' images say of photographs, by (photograph, scan), see `pair_factor`.
    """
    stations, states = placement.stations, placement.states
    body_poses: list[Rigid] = []
    fixed: list[bool] = []
    views: list[PhotoView | None] = []
    bodies = Bodies([-1] * len(stations.each))
    for k, station in enumerate(stations.each):
        if station.world_from_scanner is not None:
            bodies.scans[k] = len(body_poses)
            body_poses.append(station.world_from_scanner.inverse)
            fixed.append(station.fixed)
            views.append(None)
    camera_index = {camera.id: k for k, camera in enumerate(survey.cameras)}
    factors = stations.relative(bodies.scans)
    for photo in sorted(poses):
        bodies.photos[photo] = body = len(body_poses)
        state = states[photo]
        body_poses.append(poses[photo])
        fixed.append(False)
        views.append(photo_view(state, camera_index[state.given.camera], cameras[camera_index[state.given.camera]]))
        for (which, scan), known in relative.items():
            if which == photo and bodies.scans[scan] >= 0:
                factors.append(replace(known, body=body, base=bodies.scans[scan]))
        prior = state.given.prior
        if prior is not None:
            covariance = np.where(np.isfinite(prior.covariance), prior.covariance, 0.0)
            if prior.is_position:
                covariance = covariance + np.diag([_UNKNOWN_RAD**2] * 3 + [0.0] * 3)
            factors.append(RelativePose(body, WORLD, prior.pose, covariance, name="its prior"))
    problem = Problem(
        tuple(body_poses), np.array(fixed), tuple(views), tuple(cameras), tuple(factors), Ties.none()
    )  # fmt: skip
    return problem, bodies


def with_ties(problem: Problem, bodies: Bodies, placement: Placement) -> Problem:
    """Return the problem with the ties between its photographs, points and lines, from its present poses."""
    poses = {photo: problem.poses[body] for photo, body in bodies.photos.items()}
    cameras = {photo: problem.camera_of(body) for photo, body in bodies.photos.items()}
    scans = [k for k, body in enumerate(bodies.scans) if body >= 0]
    renumbered = {scan: k for k, scan in enumerate(scans)}
    laser = {
        (photo, renumbered[scan]): found for (photo, scan), found in placement.laser.items()
        if photo in poses and scan in renumbered
    }  # fmt: skip
    ties = tie_points(
        placement.matches, [one.features.uv for one in placement.states], poses, cameras, laser,
        [problem.poses[bodies.scans[scan]] for scan in scans],
        body_of_scan=[bodies.scans[scan] for scan in scans], body_of_photo=bodies.photos,
        drawn=placement.drawn,
    )  # fmt: skip
    return replace(problem, ties=ties, lines=lines_between(problem, placement.lines, bodies.photos, bodies.scans))


def pair_factor(result: Registration, state: PhotoState, size: int) -> RelativePose:
    """Return what a registration says of the pose for a known camera, and how that moves it.

    Of a registration that estimated the camera with the pose, the joint covariance is conditioned on the camera: with
    what all photographs say of that (`camera_unknowns`), nothing counts twice.

    Args:
        result: an accepted registration of the photograph on a scan.
        state: the photograph.
        size: number of unknowns of its camera.
    """
    pose, covariance = result.camera_from_scanner, np.asarray(result.covariance)
    pinhole, joint = result.camera.as_pinhole, result.camera_uncertainty
    if not size or pinhole is None:
        return RelativePose(0, 0, pose, covariance, name="its image on the scan")
    turn = turn_of(state.orientation)
    values = turn.T @ (_values(pinhole) - _middle(pinhole))
    if joint is not None and joint.names == INTRINSICS:
        whole = joint.covariance
        G = whole[:6, 6:] @ np.linalg.inv(whole[6:, 6:])
        covariance = whole[:6, :6] - G @ whole[6:, :6]
    else:
        by_camera = pose_by_camera(result, pinhole)
        G = np.zeros((6, len(INTRINSICS))) if by_camera is None else by_camera
    return RelativePose(0, 0, pose, (covariance + covariance.T) / 2, G @ turn, values, name="its image on the scan")


def _unknowns(camera: SurveyCamera, states: Sequence[PhotoState]) -> CameraUnknowns:
    first = states[0] if states else None
    pinhole = None if first is None else first.camera.as_pinhole
    if first is None or pinhole is None or camera.estimate == "none":
        base = first.camera if first is not None else None
        assert base is not None, "a camera without photographs is not part of the problem"
        return CameraUnknowns(base, _WORLD_CAMERA, _WORLD_CAMERA, np.zeros((0, 0)))
    turn = turn_of(first.orientation)
    values: Matrix = turn.T @ (_values(pinhole) - _middle(pinhole))
    sigmas = (DEFAULT_CAMERA_PRIOR if first.assumed else CALIBRATED_CAMERA_PRIOR).sigmas(pinhole)
    prior = np.array([sigmas.get(name, _KNOWN) for name in INTRINSICS])
    covariance = np.diag(prior**2)
    estimates = [
        one for state in states if state.alone is not None
        if (one := camera_estimate(state.given.id, state.alone, state.orientation)) is not None
    ]  # fmt: skip
    pooled = pool(estimates)
    found = (
        (pooled.values, pooled.covariance) if pooled is not None
        else _of_one(estimates[0]) if len(estimates) == 1 else None
    )  # fmt: skip
    # On coarse scans the images' own estimates can leave what was stated far behind: the ties then decide alone.
    if found is not None and (np.abs(found[0] - values) <= _MAX_FROM_STATED * prior).all():
        values, covariance = found
    if isinstance(camera.estimate, tuple):
        kept = np.array([name in camera.estimate for name in INTRINSICS])
        stated = turn.T @ (_values(pinhole) - _middle(pinhole))
        values = np.where(kept, values, stated)
        known = np.maximum(np.abs(np.array([stated[0], 1.0, pinhole.width, pinhole.width])) * _KNOWN, 1e-9)
        covariance = np.where(np.outer(kept, kept), covariance, np.diag(np.where(kept, 0.0, known**2)))
    return CameraUnknowns(first.camera, np.array(values), np.array(values), np.array(covariance))


def _of_one(estimate: CameraEstimate) -> tuple[Matrix, Matrix]:
    of_prior = np.diag(estimate.prior**-2.0)
    covariance = np.linalg.inv(of_prior + estimate.information)
    return covariance @ (of_prior @ estimate.stated + estimate.weighted), covariance


def photo_view(state: PhotoState, index: int, camera: CameraUnknowns) -> PhotoView:
    """Return how a photograph sees: the camera by its `index`, and how its values apply to its pixels."""
    pinhole = state.camera.as_pinhole
    if not camera.size or pinhole is None:
        return PhotoView(index, np.eye(4), np.zeros(4), state.camera)
    return PhotoView(index, np.asarray(turn_of(state.orientation)), _middle(pinhole), pinhole)


def _values(camera: CameraModel) -> Matrix:
    pinhole = camera.as_pinhole
    assert pinhole is not None
    k1 = pinhole.distortion[0] if pinhole.distortion else 0.0
    return np.array([pinhole.focal_px, k1, pinhole.cx, pinhole.cy])


def _middle(camera: CameraModel) -> Matrix:
    return np.array([0.0, 0.0, (camera.width - 1) / 2, (camera.height - 1) / 2])
