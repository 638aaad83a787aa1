"""A survey in a national grid, solved about an origin nearby: single precision has no digits left for millimetres
where coordinates count in hundreds of kilometres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.survey.adjustment import Adjustment
from ladarreg_core.survey.least_squares.problem import Matrix
from ladarreg_core.survey.parts import SurveyPhoto, SurveyScan
from ladarreg_core.survey.survey import Survey

_FAR_M = 1_000.0  # where single precision steps by .06 mm


def local_origin(given: Sequence[SurveyScan], scans: Sequence[Scan]) -> Matrix:
    """Return the origin (3,) about which a survey is solved, in its world, m, in whole metres; zeros if that is near.

    Args:
        given: the survey's scans.
        scans: the scans, with what their files or the survey state of their places.
    """
    from ladarreg_core.formats.documents.targets_file import read_targets, surveyed_coordinates

    places = [
        np.mean(list(known.values()), axis=0)
        for one in given
        if one.targets is not None and (known := surveyed_coordinates(read_targets(one.targets.source)))
    ]
    places = places or [
        scan.world_from_scanner.translation
        for _, scan in sorted(zip(given, scans, strict=True), key=lambda both: not both[0].fixed)
        if scan.world_from_scanner is not None
    ]
    if not places or np.abs(places[0]).max() <= _FAR_M:
        return np.zeros(3)
    return np.asarray(np.round(places[0]))


def survey_about(survey: Survey, origin: Matrix) -> Survey:
    """Return a survey whose world has its origin at a place (3,) of the former one, m; the axes are the same."""
    if not origin.any():
        return survey
    return replace(
        survey,
        scans=tuple(
            one if one.world_from_scanner is None
            else replace(one, world_from_scanner=_moved(-origin) @ one.world_from_scanner)
            for one in survey.scans
        ),
        photos=tuple(_photo_about(one, origin) for one in survey.photos),
    )  # fmt: skip


def scan_about(scan: Scan, origin: Matrix) -> Scan:
    """Return a scan whose stated place is moved into the same world."""
    if scan.world_from_scanner is None or not origin.any():
        return scan
    return replace(scan, world_from_scanner=_moved(-origin) @ scan.world_from_scanner)


def adjustment_from(adjustment: Adjustment, origin: Matrix) -> Adjustment:
    """Return the adjustment of `survey_about` in the world of the survey; the covariances are the same."""
    if not origin.any():
        return adjustment
    return replace(
        adjustment,
        scans={
            name: one if one.world_from_scanner is None
            else replace(one, world_from_scanner=_moved(origin) @ one.world_from_scanner)
            for name, one in adjustment.scans.items()
        },
        photos={
            name: one if one.camera_from_world is None
            else replace(one, camera_from_world=one.camera_from_world @ _moved(-origin))
            for name, one in adjustment.photos.items()
        },
    )  # fmt: skip


def _photo_about(photo: SurveyPhoto, origin: Matrix) -> SurveyPhoto:
    initial, prior = photo.initial, photo.prior
    if initial is not None:
        initial = initial @ _moved(origin)
    if prior is not None:
        prior = replace(prior, pose=prior.pose @ _moved(origin))
    return replace(photo, initial=initial, prior=prior)


def _moved(by: Matrix) -> Rigid:
    return Rigid(np.eye(3), by)
