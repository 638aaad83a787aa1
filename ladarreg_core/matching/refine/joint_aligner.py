"""Joint alignment of several pictures that share one pose: the faces of a wide photograph, or photographs of a rig.

Every picture is compared with a view of the scan of its own. The normal equations of all are summed in the frame of the
camera, so that each picture counts by its own evidence, and the compared regions are counted together: one pose, one
covariance, one verdict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.images.blocks import BlockMatches
from ladarreg_core.matching.images.faces import Face
from ladarreg_core.matching.images.photo_levels import PhotoLevels
from ladarreg_core.matching.images.scan_levels import ChannelFloors, ScanLevels
from ladarreg_core.matching.refine.aligner import FINE, FINE_POINTS, REFINEMENT, Aligner, finish_pose
from ladarreg_core.matching.refine.covariance import RegionEvidence, WindowEvidence, region_evidence, window_evidence
from ladarreg_core.matching.refine.ecc import RefineResult, refine_pose
from ladarreg_core.matching.verify.agreement import Agreement, joined
from ladarreg_core.matching.verify.verification import GateOptions, Verification, verify
from ladarreg_core.results.compared_blocks import ComparedBlocks

_MAX_MARKERS = 250


def aligners_of_faces(
    views: Sequence[tuple[Face, ScanLevels, PhotoLevels]],
    *,
    gate: GateOptions,
    seed: int,
    fine_points: int = FINE_POINTS,
) -> list[Aligner]:
    """Return the aligners of faces whose views show something; empty views do not amplify their noise.

    Args:
        views: faces with the levels of their views of the scan, and their own.
        gate: thresholds of verification.
        seed: random seed of the points drawn.
        fine_points: number of points of the finish and of the verdict, each, of a face.
    """
    if not views:
        return []
    floors = ChannelFloors.common([scan for _, scan, _ in views])
    made = (
        Aligner(scan.with_floors(floors), photo, gate=gate, seed=seed, fine_points=fine_points, face=face)
        for face, scan, photo in views
    )
    return [aligner for aligner in made if aligner.usable]


class JointAligner:
    """Aligns several pictures with the scan, or with a scan each.

    Args:
        aligners: those of the pictures, one or more.
        gate: thresholds of verification.
    """

    def __init__(self, aligners: Sequence[Aligner], *, gate: GateOptions) -> None:
        self.aligners = tuple(aligners)
        self.gate = gate

    def refine(self, start: Rigid, levels: Sequence[int] = (2, 1)) -> RefineResult | None:
        """Refine a pose at some levels; None if too little of the scans is visible."""
        pose, result = start, None
        for level in levels:
            result = refine_pose([aligner.picture(level) for aligner in self.aligners], pose, REFINEMENT[level])
            if result is None:
                return None
            pose = result.camera_from_scanner
        return result

    def finish(self, start: Rigid) -> Rigid:
        """Refine a pose at level 0, then at fine points, until it stops moving."""
        return finish_pose(self.aligners, start)[0]

    def agreement_at(self, pose: Rigid, level: int) -> Agreement:
        """Return the agreement of all pictures at a pose."""
        return joined([aligner.agreement_at(pose, level) for aligner in self.aligners])

    def coarse_verdict(self, pose: Rigid) -> Verification:
        """Return the preliminary verdict on a pose, from level 1 alone."""
        return verify(self.agreement_at(pose, 1), None, self.gate)

    def verify(self, pose: Rigid) -> Verification:
        """Return the verdict on a finished pose, with the regions it rests on in the photograph's pixels."""
        fine = [aligner.agreement_at(pose, 0) for aligner in self.aligners]
        verdict = verify(self.agreement_at(pose, 1), joined(fine), self.gate)
        pairs = zip(self.aligners, fine, strict=True)
        markers = [marker for aligner, agreement in pairs for marker in aligner.markers(agreement)]
        every = max(1, -(-len(markers) // _MAX_MARKERS))
        return replace(verdict, regions=tuple(markers[::every]))

    def regions(self, pose: Rigid) -> RegionEvidence | None:
        """Return the covariance of a finished pose by leaving out regions of pictures; None if they are few."""
        compared = [found for aligner in self.aligners if (found := aligner.fine_blocks(pose)) is not None]
        return region_evidence(compared, pose, FINE)

    def evidence(self, pose: Rigid) -> WindowEvidence:
        """Return the uncertainty of a finished pose: by leaving out regions, or from its windows if they are few."""
        information, agreeing, scatters = np.zeros((6, 6)), 0, []
        for aligner in self.aligners:
            maps = aligner.agreement_at(pose, 0)
            if not maps.windows:
                continue
            own, working, camera = aligner.pose(pose), aligner.photo.cameras[0], aligner.photo.source
            found = window_evidence(maps, aligner.verification_points, working, camera, own)
            # (w, c): the rotation is that of the picture, the centre that in the scanner frame
            turn = np.eye(6)
            turn[:3, :3] = own.rotation @ pose.rotation.T
            information += turn.T @ np.linalg.inv(found.covariance) @ turn
            agreeing += found.agreeing
            if np.isfinite(found.scatter_px):
                scatters.append(found.scatter_px)
        regions = self.regions(pose)
        covariance = regions.pose_covariance if regions is not None else np.linalg.pinv(information, hermitian=True)
        scatter = float(np.median(scatters)) if scatters else float("nan")
        return WindowEvidence(agreeing, (covariance + covariance.T) / 2, scatter)

    def block_matches(self, pose: Rigid) -> BlockMatches | None:
        """Return the sub-pixel matches of all pictures at a finished pose, in the photograph's pixels; None without."""
        found = [blocks for aligner in self.aligners if (blocks := aligner.block_matches(pose)) is not None]
        matched = [part for part in found if len(part.matches)]
        if not matched:
            return None
        weights = np.array([len(part.matches) for part in matched], dtype=np.float64)
        scatter = float(np.sqrt(np.average([part.scatter_px**2 for part in matched], weights=weights)))
        return BlockMatches(
            Matches.joined([part.matches for part in matched]),
            np.concatenate([part.inliers for part in matched]),
            scatter,
            ComparedBlocks.joined([part.compared for part in found if part.compared is not None]),
        )
