"""Reads earlier results: a `registration.json`, and the offset between two cameras of a mount."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast, get_args

import numpy as np

from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import FormatError, ShapeError
from ladarreg_core.formats.cameras.camera_file import camera_from_fields
from ladarreg_core.formats.documents.own_results import EDITED_REASON, TRUST_OPTION, read_own_result, was_edited
from ladarreg_core.formats.documents.pose_file import GUESS_FIELD, POSE_FIELD, read_pose
from ladarreg_core.formats.parsing.json_file import choice, number, parsed_once, read_json_object
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.results.compared_blocks import ComparedBlocks
from ladarreg_core.results.offset import STATED_OFFSET_SIGMA_M, STATED_OFFSET_SIGMA_RAD, Offset
from ladarreg_core.results.registration import Registration
from ladarreg_core.results.verdict_words import GIVEN_MARK, Evidence

_ASYMMETRY = 1e-6
_UNKNOWN = np.full((6, 6), np.nan)
_MATCH_COLUMNS: dict[str, tuple[int, ...]] = {
    "ray": (-1, 3), "uv": (-1, 2), "range_m": (-1,),
    "residual_px": (-1, 2), "residual_m": (-1,), "stereo_depth_error_m": (-1,),
}  # fmt: skip


def read_registration(path: PathLike, *, trust_edited: bool = False, option: str = TRUST_OPTION) -> Registration:
    """Read a `registration.json`: pose, camera, covariance and verdict, without its matches and steps.

    Of a refused registration, `camera_from_scanner` is its best guess, as in the result that was written; `accepted` is
    False, and `has_pose` says whether there was one. The covariance of a pose that was given is NaN.

    Args:
        path: the file.
        trust_edited: read a file that was changed after it was written; its pose then is `given`.
        option: what can be done about such a file, for messages.

    Raises:
        FormatError: if it is not such a file, was changed after it was written, or a number in it is invalid.
        CameraError: if its camera is invalid.
    """
    with reading(path) as file, parsed_once():
        fields = read_own_result(file, "a registration", trust_edited=trust_edited, option=option)
        if trust_edited and was_edited(file, fields):
            fields = as_given(fields)
        refused = fields.get("accepted") is False and fields.get("evidence") != "given"  # a given pose is shown
        refused = refused and fields.get(POSE_FIELD) is None and GUESS_FIELD in fields
        has_pose = not refused or fields[GUESS_FIELD] is not None
        pose = read_pose(path, field=GUESS_FIELD if refused else POSE_FIELD) if has_pose else Rigid.identity()
        if not isinstance(fields.get("camera"), dict) or not isinstance(fields.get("accepted"), bool):
            raise FormatError("it has a pose but lacks a camera or a verdict; give the registration.json of a result")
        sigma = fields.get("sigma") if isinstance(fields.get("sigma"), dict) else {}
        assert isinstance(sigma, dict)
        reasons = fields.get("reasons", [])
        if not isinstance(reasons, list) or not all(isinstance(reason, str) for reason in reasons):
            raise FormatError(f"the field 'reasons' is {one_line(repr(reasons), 60)}; it must be a list of sentences")
        return Registration(
            camera_from_scanner=pose,
            camera=camera_from_fields(fields["camera"]),
            matches=Matches.none(),
            inliers=np.zeros(0, np.bool_),
            residuals_px=np.zeros((0, 2)),
            residuals_m=np.zeros(0),
            stereo_depth_error_m=np.zeros(0),
            world_from_scanner=None
            if fields.get("world_from_scanner") is None
            else read_pose(path, field="world_from_scanner"),
            covariance=_UNKNOWN
            if fields.get("covariance") is None and fields.get("evidence") == "given"
            else _covariance(fields.get("covariance")),
            camera_uncertainty=_camera_uncertainty(fields.get("camera_uncertainty")),
            chi2_per_dof=float("nan"),
            sigma_px=number(sigma, "pixel_px", 1.0),
            sigma_range_m=number(sigma, "range_m", 0.015),
            accepted=fields["accepted"],
            said_coarse=fields.get("coarse") is True,
            evidence=cast(Evidence, choice(fields, "evidence", get_args(Evidence))),
            reasons=tuple(reasons),
            diagnostics={} if has_pose else {"no_candidate": True},
            method=one_line(fields.get("method", "auto"), 40),
        )


def as_given(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a registration that was changed: its pose is given, not verified; a refused one stays so."""
    found = {**fields, "accepted": False}
    if fields.get(POSE_FIELD) is None:
        return {**found, "evidence": "none"}
    reasons = fields.get("reasons")
    found.pop("camera_uncertainty", None)
    found.pop("blocks", None)
    return {
        **found,
        "evidence": "given",
        "mark": GIVEN_MARK,
        "covariance": None,
        "reasons": [EDITED_REASON, *(reasons if isinstance(reasons, list) else [])],
    }


def read_result(path: PathLike, *, trust_edited: bool = False) -> tuple[Registration, dict[str, Any]]:
    """Read a `registration.json` with its matches, and return the whole document, too.

    Args:
        path: the file.
        trust_edited: as in `read_registration`; the document then says `given`, too.

    Raises:
        FormatError: if it is not such a file, was changed after it was written, or a number in it is invalid.
        CameraError: if its camera is invalid.
    """
    with parsed_once(), reading(path) as file:
        registration = read_registration(path, trust_edited=trust_edited)
        document = read_json_object(file, "a registration")
        if trust_edited and was_edited(file, document):
            document = as_given(document)
        try:
            listed = document["matches"]
            columns = {
                name: np.array([_undefined(item[name]) for item in listed], dtype=np.float64).reshape(shape)
                for name, shape in _MATCH_COLUMNS.items()
            }
            matches = Matches(
                columns["ray"], columns["range_m"], columns["uv"], tuple(str(item["pick_id"]) for item in listed)
            )
            inliers = np.array([item["inlier"] is True for item in listed], dtype=np.bool_)
            blocks = ComparedBlocks.from_fields(document["blocks"]) if document.get("blocks") else None
        except ShapeError as error:
            raise FormatError(f"{one_line(error, 100)}; give an unmodified registration.json") from None
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(
                f"the field 'matches' is damaged ({one_line(error, 60)}); give an unmodified registration.json"
            ) from None
        chi2 = document["sigma"].get("chi2_per_dof") if isinstance(document.get("sigma"), dict) else None
        return replace(
            registration,
            matches=matches,
            inliers=inliers,
            residuals_px=columns["residual_px"],
            residuals_m=columns["residual_m"],
            stereo_depth_error_m=columns["stereo_depth_error_m"],
            chi2_per_dof=float(chi2) if isinstance(chi2, int | float) else float("nan"),
            camera_sigmas=_sigmas(document.get("camera_sigmas")),
            blocks=blocks,
        ), document


def _undefined(value: Any) -> Any:
    """Return a value or a list of values with NaN in place of null."""
    if isinstance(value, list):
        return [_undefined(item) for item in value]
    return float("nan") if value is None else value


def _sigmas(found: Any) -> dict[str, float]:
    if not isinstance(found, dict):
        return {}
    return {str(name): float(value) for name, value in found.items() if isinstance(value, int | float)}


def read_offset(path: PathLike) -> Offset:
    """Read the offset between two cameras of a mount.

    The file is a pose JSON with `camera_b_from_camera_a`, or with `camera_from_scanner` in that meaning, and optionally
    `sigma_angle_rad` and `sigma_position_m`.

    Raises:
        FormatError: if it contains no rigid transform, or a sigma is not a number.
        OptionError: if a sigma is negative.
    """
    with reading(path) as file, parsed_once():
        fields = read_json_object(file, "an offset")
        named = "camera_b_from_camera_a" in fields
        angle = number(fields, "sigma_angle_rad", STATED_OFFSET_SIGMA_RAD)
        position = number(fields, "sigma_position_m", STATED_OFFSET_SIGMA_M)
        return Offset(read_pose(path, field="camera_b_from_camera_a") if named else read_pose(path), angle, position)


def _camera_uncertainty(fields: Any) -> CameraUncertainty | None:
    """Return the uncertainty of pose and camera; None in files of calibrated cameras, and in older files."""
    if fields is None:
        return None
    if not isinstance(fields, dict):
        raise FormatError("the field 'camera_uncertainty' is not an object; give an unmodified registration.json")
    try:
        return CameraUncertainty.from_fields(fields)
    except ShapeError as error:
        raise FormatError(f"{error}; give an unmodified registration.json") from None


def _covariance(rows: Any) -> FloatArray:
    """Return a covariance (6, 6), checked for symmetry and non-negative variances."""
    square = isinstance(rows, list) and len(rows) == 6 and all(isinstance(row, list) and len(row) == 6 for row in rows)
    if not square:
        raise FormatError(f"the field 'covariance' is {one_line(repr(rows), 60)}; it must be 6 rows of 6 numbers")
    matrix = np.array([[number({"covariance": value}, "covariance") for value in row] for row in rows])
    scale = np.sqrt(np.abs(np.diag(matrix)))
    if (np.abs(matrix - matrix.T) > _ASYMMETRY * np.outer(scale, scale) + 1e-300).any():
        raise FormatError("the field 'covariance' is not symmetric; give an unmodified registration.json")
    if (np.diag(matrix) < 0).any():
        raise FormatError("the field 'covariance' has negative variances; give an unmodified registration.json")
    return matrix
