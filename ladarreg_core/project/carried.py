"""Poses carried over from one scan to another of the same place, whose frames are known to each other."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, skew
from ladarreg_core.project.document import PoseEntry, Rows
from ladarreg_core.project.results import no_matches
from ladarreg_core.project.source import Source
from ladarreg_core.project.stored_arrays import StoredArrays


def carried_pose(pose: PoseEntry, from_new: Rigid, source: Source, *, sigma_m: float, sigma_rad: float) -> PoseEntry:
    """Return a pose as it is at another scan; its verdict stays, its matches, which lie on the former scan, do not.

    A rotation dt of the one scan in the frame of the other turns the camera by -R dt and moves its centre, which lies
    at l from that scanner, by dt x l; the covariance grows by these, l being that of the farther scanner, and by the
    scanner's position.

    Args:
        pose: the pose at the former scan.
        from_new: transforms the frame of the new scan into that of the former one.
        source: the new scan.
        sigma_m: standard deviation of the place of the one in the other, m, of all axes together.
        sigma_rad: of its direction, rad.
    """
    was = Rigid.from_matrix(np.array(pose.camera_from_scanner))
    now = was @ from_new
    covariance: Rows = ()
    if pose.covariance:
        J = np.eye(6)
        J[3:, 3:] = from_new.rotation.T
        farther = max(now.centre, from_new.rotation.T @ was.centre, key=lambda at: float(np.linalg.norm(at)))
        turned = np.vstack([-now.rotation, -skew(farther)])
        found = J @ np.array(pose.covariance) @ J.T + turned @ turned.T * sigma_rad**2 / 3
        found[3:, 3:] += np.eye(3) * sigma_m**2 / 3
        covariance = _rows((found + found.T) / 2)
    world = None if pose.world_from_scanner is None else Rigid.from_matrix(np.array(pose.world_from_scanner)) @ from_new
    name = pose.name
    return replace(
        pose, camera_from_scanner=_rows(now.matrix), covariance=covariance, camera_uncertainty=None,
        world_from_scanner=None if world is None else _rows(world.matrix),
        # every pose has arrays of its own name, also those without matches
        arrays=StoredArrays.of({**no_matches(), "of": np.array([name, source.path])}),
        clouds=len(source.paths), ranges=source.ranges, carried_from=name,
    )  # fmt: skip


def _rows(matrix: FloatArray) -> Rows:
    return tuple(tuple(float(value) for value in row) for row in matrix)
