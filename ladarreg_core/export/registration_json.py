"""`registration.json`: the pose, how good it is, and how it was found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.export.json import (
    CAMERA_FROM_SCANNER_IS,
    input_document,
    plain,
    software_document,
    thesis_document,
)
from ladarreg_core.quality.assessment import Assessment
from ladarreg_core.quality.smoothing import SmoothedScan
from ladarreg_core.results import Registration
from ladarreg_core.surface.texture import Label

_VERSION = 1


def registration_document(
    registration: Registration,
    *,
    assessment: Assessment | None = None,
    smoothed: SmoothedScan | None = None,
    inputs: Sequence[str | Path] = (),
) -> dict[str, Any]:
    """Return a registration as a JSON-ready document; a number that does not exist is None.

    Args:
        registration: the result.
        assessment: what there is to say of it; None: that part of the document is empty.
        smoothed: the scan that the models show, where spikes were looked for.
        inputs: the files it came from; their names, sizes and SHA-256 are kept, not their folders.

    Raises:
        ExportError: if an input file cannot be read.
    """
    r = registration
    scanner_from_camera = r.camera_from_scanner.inverse
    document = {
        "version": _VERSION,
        "camera_from_scanner": r.camera_from_scanner.matrix,
        "camera_from_scanner_is": CAMERA_FROM_SCANNER_IS,
        "scanner_from_camera": scanner_from_camera.matrix,
        "scanner_from_camera_is": "the inverse: maps camera points to the scanner; its last column is the camera's "
        "centre in the scanner frame",
        "camera": r.camera.as_fields(),
        "camera_sigmas": dict(r.camera_sigmas),
        "covariance": np.asarray(r.covariance),
        "covariance_is": "of (w, c): R_true = exp([w]x) R (rad), c = true minus estimated camera centre in the "
        "scanner frame (m)",
        "sigma": {
            "angle_rad": r.sigma_angle_rad,
            "position_m": r.sigma_position_m,
            "pixel_px": r.sigma_px,
            "range_m": r.sigma_range_m,
            "chi2_per_dof": r.chi2_per_dof,
        },
        "thesis_parameters": thesis_document(r.thesis_parameters),
        "accepted": bool(r.accepted),
        "evidence": r.evidence,
        "reasons": list(r.reasons),
        "matches": [
            {
                "pick_id": pick_id,
                "inlier": r.inliers[k],
                "residual_px": r.residuals_px[k],
                "residual_m": r.residuals_m[k],
                "stereo_depth_error_m": r.stereo_depth_error_m[k],
                "uv": r.matches.uv[k],
                "ray": r.matches.rays[k],
                "range_m": r.matches.ranges[k],
                "influence": _influence(assessment, k),
            }
            for k, pick_id in enumerate(r.matches.pick_ids)
        ],
        "labels": {str(label.value): label.name.lower() for label in Label},
        "method": r.method,
        "steps": [
            {
                "name": step.name,
                "seconds": step.seconds,
                "matches": None if step.matches is None else len(step.matches),
                "detail": step.detail,
            }
            for step in r.steps
        ],
        "diagnostics": r.diagnostics,
        **_assessed(assessment),
        "smoothing": None
        if smoothed is None
        else {"cells_replaced": smoothed.cells_replaced, "sentence": smoothed.sentence},
        "options": r.options,
        "seed": r.seed,
        "inputs": [input_document(Path(path)) for path in inputs],
        "software": software_document(),
    }
    ready = plain(document)
    assert isinstance(ready, dict)
    return ready


def _influence(assessment: Assessment | None, k: int) -> dict[str, float] | None:
    """Return how far the pose moves without match k; None also for numbers where the rest determines no pose."""
    found = None if assessment is None else assessment.influence
    if found is None:
        return None
    return {name: getattr(found, name)[k] for name in ("position_m", "angle_rad", "pixels", "cook")}


def _assessed(assessment: Assessment | None) -> dict[str, Any]:
    a = assessment
    uncertainty = None if a is None else a.uncertainty
    return {
        "findings": [
            {
                "name": finding.name,
                "level": finding.level,
                "sentence": finding.sentence,
                "what_to_do": finding.what_to_do,
                "values": finding.values,
            }
            for finding in (a.findings or () if a is not None else ())
        ],
        "uncertainty": None
        if uncertainty is None
        else {
            "median_px": uncertainty.median_px,
            "p95_px": uncertainty.p95_px,
            "worst_px": uncertainty.worst_px,
            "worst_cell": uncertainty.worst_cell,
            "worst_uv": uncertainty.worst_uv,
        },
        "advice": [
            {"sentence": place.summary(), "cell": place.cell, "uv": place.uv, "gain": place.gain}
            for place in (a.advice or () if a is not None else ())
        ],
        "not_assessed": {} if a is None else a.absent,
    }
