"""Earlier results as files: a registration's pose and how sure it is, and the offset between two cameras."""

from __future__ import annotations

from typing import Any, cast, get_args

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.camera_file import camera_from_fields
from ladarreg_core.formats.json_file import choice, number, parsed_once, read_json_object
from ladarreg_core.formats.pose_file import read_pose
from ladarreg_core.formats.untrusted import PathLike, one_line, reading
from ladarreg_core.matches import Matches
from ladarreg_core.results import STATED_OFFSET_SIGMA_M, STATED_OFFSET_SIGMA_RAD, Evidence, Offset, Registration

_ASYMMETRY = 1e-6


def read_registration(path: PathLike) -> Registration:
    """Read a `registration.json`: pose, camera, covariance and verdict; its matches and steps are left behind.

    Raises:
        FormatError: if it is no such file, or its numbers are none.
        CameraError: if its camera is none.
    """
    with reading(path) as file, parsed_once():
        pose = read_pose(path)
        fields = read_json_object(file, "a registration")
        if not isinstance(fields.get("camera"), dict) or not isinstance(fields.get("accepted"), bool):
            raise FormatError("it has a pose, but neither camera nor verdict; give the registration.json of a result")
        sigma = fields.get("sigma") if isinstance(fields.get("sigma"), dict) else {}
        assert isinstance(sigma, dict)
        reasons = fields.get("reasons", [])
        if not isinstance(reasons, list) or not all(isinstance(reason, str) for reason in reasons):
            raise FormatError(f"the field 'reasons' is {one_line(repr(reasons), 60)}; it must be a list of sentences")
        return Registration(
            camera_from_scanner=pose,
            camera=camera_from_fields(fields["camera"]),
            matches=Matches(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2))),
            inliers=np.zeros(0, np.bool_),
            residuals_px=np.zeros((0, 2)),
            residuals_m=np.zeros(0),
            stereo_depth_error_m=np.zeros(0),
            covariance=_covariance(fields.get("covariance")),
            chi2_per_dof=float("nan"),
            sigma_px=number(sigma, "pixel_px", 1.0),
            sigma_range_m=number(sigma, "range_m", 0.015),
            accepted=fields["accepted"],
            evidence=cast(Evidence, choice(fields, "evidence", get_args(Evidence))),
            reasons=tuple(reasons),
            method=one_line(fields.get("method", "auto"), 40),
        )


def read_offset(path: PathLike) -> Offset:
    """Read the offset between two cameras of a mount.

    It is a pose JSON whose `camera_from_scanner` means camera_b_from_camera_a (which is also a name for it), and may
    hold `sigma_angle_rad` and `sigma_position_m`.

    Raises:
        FormatError: if it holds no rigid transform, or a sigma that is no number.
        OptionError: if a sigma is negative.
    """
    with reading(path) as file, parsed_once():
        fields = read_json_object(file, "an offset")
        named = "camera_b_from_camera_a" in fields
        angle = number(fields, "sigma_angle_rad", STATED_OFFSET_SIGMA_RAD)
        position = number(fields, "sigma_position_m", STATED_OFFSET_SIGMA_M)
        return Offset(read_pose(path, field="camera_b_from_camera_a") if named else read_pose(path), angle, position)


def _covariance(rows: Any) -> FloatArray:
    """Return a covariance (6, 6)."""
    square = isinstance(rows, list) and len(rows) == 6 and all(isinstance(row, list) and len(row) == 6 for row in rows)
    if not square:
        raise FormatError(f"the field 'covariance' is {one_line(repr(rows), 60)}; it must be 6 rows of 6 numbers")
    matrix = np.array([[number({"covariance": value}, "covariance") for value in row] for row in rows])
    scale = np.sqrt(np.abs(np.diag(matrix)))
    if (np.abs(matrix - matrix.T) > _ASYMMETRY * np.outer(scale, scale) + 1e-300).any():
        raise FormatError("the field 'covariance' is not symmetric; give the registration.json as it was written")
    if (np.diag(matrix) < 0).any():
        raise FormatError("the field 'covariance' has negative variances; give the registration.json as it was written")
    return matrix
