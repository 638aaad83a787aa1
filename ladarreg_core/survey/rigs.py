"""Rigs of a survey: photographs that were taken at one moment by sensors that are fixed to each other.

Where the images of scans verify two sensors of a rig in several frames, their relative pose is known, and holds a
photograph that no scan resolves by another one of its frame. Photographs that are verified by themselves are not moved
by it: they are what it is measured on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ladarreg_core.frames import Rigid, skew
from ladarreg_core.survey.build import Bodies
from ladarreg_core.survey.least_squares.problem import RIG, Matrix, RelativePose, moved_pose, pose_difference
from ladarreg_core.survey.least_squares.solver import Adjusted
from ladarreg_core.survey.placement import PhotoState
from ladarreg_core.survey.survey import Survey

_MIN_FRAMES = 3  # frames that have to agree on a relative pose that nobody stated
_STATED_RAD, _STATED_M = float(np.radians(0.03)), 0.002  # of a relative pose that is stated
_FLOOR = np.diag([float(np.radians(0.003)) ** 2] * 3 + [2e-4**2] * 3)  # of what a rig that bends may move
_DIFFERS = 27.9  # squared Mahalanobis distance with 6 degrees of freedom, exceeded once in 10,000


@dataclass(frozen=True, slots=True, eq=False)
class SensorPair:
    """The pose of one sensor of a rig relative to another."""

    first_from_second: Rigid
    covariance: Matrix
    """(6, 6) of (w, c): w about the axes of the first sensor, c in the frame of the second."""
    frames: tuple[str, ...]
    """Frames that it was measured in; empty: it is stated."""


@dataclass(frozen=True, slots=True, eq=False)
class Rigs:
    """The rigs of a survey, as far as their sensors are known."""

    pairs: Mapping[tuple[str, str, str], SensorPair]
    """By rig, first sensor and second sensor; both orders are there."""
    frames: Mapping[tuple[str, str], Mapping[str, int]]
    """The photographs of each frame, by rig and frame, then by sensor."""

    def mate_of(self, photo: int, state: PhotoState, verified: Sequence[bool]) -> tuple[int, SensorPair] | None:
        """Return the verified photograph of the same frame that holds a photograph best; None: there is none."""
        rig = state.given.rig
        if rig is None:
            return None
        found = [
            (self.pairs[rig.id, rig.sensor, sensor], mate)
            for sensor, mate in self.frames[rig.id, rig.frame].items()
            if mate != photo and verified[mate] and (rig.id, rig.sensor, sensor) in self.pairs
        ]
        if not found:
            return None
        pair, mate = min(found, key=lambda one: float(np.trace(one[0].covariance[3:, 3:])))
        return mate, pair


def rigs_of(survey: Survey, states: Sequence[PhotoState], adjusted: Adjusted, bodies: Bodies) -> Rigs:
    """Return the rigs of a survey: relative poses that are stated, or measured on verified photographs.

    Args:
        survey: the survey.
        states: its photographs.
        adjusted: a solution with those that are verified.
        bodies: where they stand in it.
    """
    frames: dict[tuple[str, str], dict[str, int]] = {}
    for k, state in enumerate(states):
        rig = state.given.rig
        if rig is not None:
            frames.setdefault((rig.id, rig.frame), {})[rig.sensor] = k
    pairs: dict[tuple[str, str, str], SensorPair] = {}
    for name, sensors in survey.rigs.items():
        known = sorted({*sensors, *(sensor for (one, _), found in frames.items() if one == name for sensor in found)})
        for a, b in combinations(known, 2):
            pair = _stated(sensors, a, b) or _measured(name, a, b, frames, states, adjusted, bodies)
            if pair is not None:
                pairs[name, a, b], pairs[name, b, a] = pair, _turned_round(pair)
    return Rigs(pairs, frames)


def rig_factors(rigs: Rigs, states: Sequence[PhotoState], bodies: Bodies) -> list[RelativePose]:
    """Return what rigs say of photographs that no scan's image verifies."""
    verified = [state.by_image and k in bodies.photos for k, state in enumerate(states)]
    found = []
    for photo, body in bodies.photos.items():
        held = None if verified[photo] else rigs.mate_of(photo, states[photo], verified)
        if held is not None:
            mate, pair = held
            found.append(RelativePose(body, bodies.photos[mate], pair.first_from_second, pair.covariance, name=RIG))
    return found


def start_from_rig(rigs: Rigs, photo: int, states: Sequence[PhotoState]) -> Rigid | None:
    """Return `camera_from_world` of a photograph by a verified one of its frame; None: there is none."""
    held = rigs.mate_of(photo, states[photo], [one.by_image and one.pose is not None for one in states])
    if held is None:
        return None
    mate, pair = held
    pose = states[mate].pose
    assert pose is not None
    return pair.first_from_second @ pose


def _stated(sensors: Mapping[str, Rigid | None], a: str, b: str) -> SensorPair | None:
    first, second = sensors.get(a), sensors.get(b)
    reference = next(iter(sensors), None)
    first = Rigid.identity() if first is None and a == reference else first
    second = Rigid.identity() if second is None and b == reference else second
    if first is None or second is None:
        return None
    known = np.diag([_STATED_RAD**2] * 3 + [_STATED_M**2] * 3)
    return SensorPair(first @ second.inverse, known, ())


def _measured(
    rig: str, a: str, b: str, frames: Mapping[tuple[str, str], Mapping[str, int]], states: Sequence[PhotoState],
    adjusted: Adjusted, bodies: Bodies,
) -> SensorPair | None:  # fmt: skip
    """Return the relative pose that verified photographs of the same frames agree on; None: too few do."""
    found: list[tuple[str, Rigid, Matrix]] = []
    for (one, frame), members in frames.items():
        photos = [members.get(name) for name in (a, b)]
        if one == rig and all(k is not None and k in bodies.photos and states[k].by_image for k in photos):
            first, second = (bodies.photos[k] for k in photos if k is not None)
            found.append((frame, *_relative(adjusted, first, second)))
    while len(found) >= _MIN_FRAMES:
        pose, covariance = _mean([(one, known) for _, one, known in found])
        off = [pose_difference(one, pose) for _, one, _ in found]
        against = [float(d @ np.linalg.solve(known, d)) for d, (_, _, known) in zip(off, found, strict=True)]
        worst = int(np.argmax(against))
        if against[worst] <= _DIFFERS:
            scatter = max(sum(against) / (6 * (len(found) - 1)), 1.0)
            return SensorPair(pose, covariance * scatter + _FLOOR, tuple(frame for frame, _, _ in found))
        del found[worst]  # one of its photographs is wrong, or the rig was knocked
    return None


def _relative(adjusted: Adjusted, first: int, second: int) -> tuple[Rigid, Matrix]:
    """Return first_from_second of two bodies, and its covariance of (w, c).

    With T = A B^-1, R its rotation and c the centre of A in the frame of B: w = w_A - R w_B,
    dc = R_B (c_A - c_B) - [c]x w_B.
    """
    one, other = adjusted.problem.poses[first], adjusted.problem.poses[second]
    pose = one @ other.inverse
    J = np.zeros((6, 12))
    J[:3, :3], J[:3, 6:9] = np.eye(3), -pose.rotation
    J[3:, 3:6], J[3:, 9:] = other.rotation, -other.rotation
    J[3:, 6:9] = -skew(pose.centre)
    both = (first, second)
    joint = np.block([[adjusted.covariance_between(i, j) for j in both] for i in both])
    covariance = J @ joint @ J.T + _FLOOR
    return pose, np.asarray((covariance + covariance.T) / 2)


def _mean(found: Sequence[tuple[Rigid, Matrix]]) -> tuple[Rigid, Matrix]:
    """Return the mean of poses by their covariances, and its covariance."""
    pose = found[0][0]
    information = [np.linalg.inv(known) for _, known in found]
    total = np.sum(information, axis=0)
    for _ in range(5):
        pull = np.sum([W @ pose_difference(one, pose) for W, (one, _) in zip(information, found, strict=True)], axis=0)
        pose = moved_pose(pose, np.linalg.solve(total, pull))
    return pose, np.linalg.inv(total)


def _turned_round(pair: SensorPair) -> SensorPair:
    """Return the pose of the second sensor relative to the first; its covariance by differences."""
    pose, back = pair.first_from_second, pair.first_from_second.inverse
    J = np.zeros((6, 6))
    step = 1e-6
    for k in range(6):
        move = np.zeros(6)
        move[k] = step
        J[:, k] = pose_difference(moved_pose(pose, move).inverse, back) / step
    return SensorPair(back, J @ pair.covariance @ J.T, pair.frames)
