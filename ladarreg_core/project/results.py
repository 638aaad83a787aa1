"""Conversion between registrations and their entries in a document; only the matches of single steps are dropped."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, cast

import msgspec
import numpy as np

from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import DegenerateGeometryError, FormatError, LadarregError
from ladarreg_core.export.json import plain
from ladarreg_core.formats.cameras.camera_file import camera_from_fields
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.project.document import PickEntry, PoseEntry, StepEntry
from ladarreg_core.project.stored_arrays import StoredArrays
from ladarreg_core.results.compared_blocks import ComparedBlocks
from ladarreg_core.results.registration import PoseResult, Registration, StageId
from ladarreg_core.results.steps import Step

_MATCH_ARRAYS = ("rays", "ranges", "uv", "fractions", "weights", "range_weights", "directions", "across")
_RESULT_ARRAYS = ("inliers", "residuals_px", "residuals_m", "stereo_depth_error_m")
_BLOCK_ARRAYS = ("uv", "offset_px", "information", "correlation", "agrees")
_SOLVED_ON = "solved_on"
"""Name of the array with the picks, as JSON; in an array because the document is written at every edit."""


def pose_entry(
    stage: StageId,
    result: PoseResult,
    *,
    picks: Iterable[PickEntry] | None = None,
    method: str = "manual",
    seconds: float = 0.0,
    note: str = "",
    clouds: int = 1,
    ranges: str = "",
) -> PoseEntry:
    """Return the document entry of a result.

    Args:
        stage: stage of the estimator.
        result: the result.
        picks: the picks that it was solved on, of which the enabled ones are kept; None: not known.
        method: registration method, for results that do not carry it.
        seconds: wall time, for results without steps.
        note: remark of the estimator.
        clouds: number of clouds of the scan that it was solved on.
        ranges: name of its ranges then, see `Source.ranges`.

    Raises:
        DegenerateGeometryError: if the covariance or a noise level is not finite, which project files cannot store.
    """
    sigmas = [result.sigma_px, result.sigma_range_m, *result.camera_sigmas.values()]
    known = np.isfinite(result.covariance).all()
    if not ((known or result.evidence == "given") and np.isfinite(sigmas).all()):
        raise DegenerateGeometryError("the matches do not determine the pose, so the result was not kept; add matches")
    arrays: dict[str, Any] = {name: getattr(result.matches, name) for name in _MATCH_ARRAYS}
    arrays |= {name: getattr(result, name) for name in _RESULT_ARRAYS}
    arrays["pick_ids"] = np.array(result.matches.pick_ids, dtype=np.str_)
    if result.blocks is not None:
        arrays |= {f"block_{name}": getattr(result.blocks, name) for name in _BLOCK_ARRAYS}
        arrays["block_ids"] = np.array(result.blocks.ids, dtype=np.str_)
    if picks is not None:
        kept = msgspec.json.encode([pick for pick in picks if pick.on])
        arrays[_SOLVED_ON] = np.frombuffer(kept, np.uint8)
    steps: tuple[Step, ...] = result.steps if isinstance(result, Registration) else ()
    return PoseEntry(
        stage=stage,
        method=result.method if isinstance(result, Registration) else method,
        arrays=StoredArrays.of(arrays),
        camera_from_scanner=_rows(result.camera_from_scanner.matrix),
        camera=plain(result.camera.as_fields()),
        world_from_scanner=None if result.world_from_scanner is None else _rows(result.world_from_scanner.matrix),
        covariance=_rows(result.covariance) if known else (),
        chi2_per_dof=float(result.chi2_per_dof) if math.isfinite(result.chi2_per_dof) else None,
        sigma_px=float(result.sigma_px),
        sigma_range_m=float(result.sigma_range_m),
        camera_sigmas={name: float(value) for name, value in result.camera_sigmas.items()},
        camera_uncertainty=None if result.camera_uncertainty is None else result.camera_uncertainty.as_fields(),
        accepted=bool(result.accepted),
        evidence=result.evidence,
        reasons=tuple(result.reasons),
        diagnostics=plain(result.diagnostics),
        steps=tuple(StepEntry(name=s.name, seconds=s.seconds, detail=plain(s.detail)) for s in steps),
        options=plain(result.options) if isinstance(result, Registration) else {},
        seed=result.seed if isinstance(result, Registration) else 0,
        seconds=seconds or sum(step.seconds for step in steps),
        note=note,
        clouds=clouds,
        ranges=ranges,
    )


def no_matches() -> dict[str, Any]:
    """Return the arrays of an entry without matches."""
    matches = Matches.none()
    shapes = {"inliers": (0,), "residuals_px": (0, 2), "residuals_m": (0,), "stereo_depth_error_m": (0,)}
    arrays: dict[str, Any] = {name: getattr(matches, name) for name in _MATCH_ARRAYS}
    arrays |= {name: np.zeros(shapes[name], np.bool_ if name == "inliers" else np.float64) for name in _RESULT_ARRAYS}
    return {**arrays, "pick_ids": np.array([], np.str_)}


def pose_of(entry: PoseEntry) -> Rigid:
    """Return the pose (camera_from_scanner) of an entry, which is available even if its matches are missing.

    Raises:
        FormatError: if it is not a valid pose.
    """
    try:
        return Rigid.from_matrix(np.array(entry.camera_from_scanner))
    except LadarregError as error:
        raise FormatError(f"the pose of the stage '{entry.stage}' is damaged ({error}); solve again") from None


def solved_on(entry: PoseEntry) -> tuple[PickEntry, ...] | None:
    """Return the enabled picks as they were when the pose was solved; None if that is not known.

    Poses of older versions of the program do not know it, nor do poses whose arrays are missing.
    """
    try:
        kept = entry.arrays.arrays().get(_SOLVED_ON)
        return None if kept is None else msgspec.json.decode(kept.tobytes(), type=tuple[PickEntry, ...])
    except (FormatError, msgspec.DecodeError):
        return None


def registration_of(entry: PoseEntry) -> Registration:
    """Return the registration stored in an entry.

    Raises:
        FormatError: if the stored data are missing or damaged.
    """
    arrays = cast(dict[str, Any], entry.arrays.arrays())
    try:
        matches = Matches(
            arrays["rays"], arrays["ranges"], arrays["uv"], tuple(map(str, arrays["pick_ids"])),
            arrays["fractions"], arrays["weights"], arrays["range_weights"], arrays["directions"], arrays["across"],
        )  # fmt: skip
        return Registration(
            camera_from_scanner=Rigid.from_matrix(np.array(entry.camera_from_scanner)),
            camera=camera_from_fields(entry.camera),
            world_from_scanner=None
            if entry.world_from_scanner is None
            else Rigid.from_matrix(np.array(entry.world_from_scanner)),
            matches=matches,
            covariance=np.array(entry.covariance) if entry.covariance else np.full((6, 6), np.nan),
            chi2_per_dof=math.nan if entry.chi2_per_dof is None else entry.chi2_per_dof,
            sigma_px=entry.sigma_px,
            sigma_range_m=entry.sigma_range_m,
            camera_sigmas=entry.camera_sigmas,
            camera_uncertainty=None
            if entry.camera_uncertainty is None
            else CameraUncertainty.from_fields(entry.camera_uncertainty),
            accepted=entry.accepted,
            evidence=entry.evidence,
            reasons=entry.reasons,
            diagnostics=entry.diagnostics,
            method=entry.method,
            steps=tuple(Step(s.name, s.seconds, detail=s.detail) for s in entry.steps),
            options=entry.options,
            seed=entry.seed,
            blocks=_blocks_of(arrays),
            **{name: arrays[name] for name in _RESULT_ARRAYS},
        )
    except (KeyError, LadarregError) as error:
        raise FormatError(f"the pose of the stage '{entry.stage}' is damaged ({error}); solve again") from None


def _blocks_of(arrays: Mapping[str, Any]) -> ComparedBlocks | None:
    """Return the blocks among the arrays of an entry; None in those of older versions, and where there are none."""
    if "block_ids" not in arrays:
        return None
    return ComparedBlocks(
        ids=tuple(map(str, arrays["block_ids"])), **{name: arrays[f"block_{name}"] for name in _BLOCK_ARRAYS}
    )


def _rows(matrix: Any) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in np.asarray(matrix))
