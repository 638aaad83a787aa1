"""The pieces of a sweep as `LineSweep`s: stops of one tilt and direction together, each pass of a moving unit alone."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.line_sweep import LineSweep, UnitTrack
from ladarreg_core.acquisition.runs.piece_list import ListedPiece
from ladarreg_core.errors import FormatError, ShapeError
from ladarreg_core.formats.parsing.untrusted import reading
from ladarreg_core.foundations.progress import Progress, Report

_SAME_TILT_RAD = float(np.radians(0.02))
_MAX_VALUES = 200_000_000


def read_sweeps(pieces: Sequence[ListedPiece], *, report: Report | None = None) -> tuple[list[LineSweep], list[int]]:
    """Read the pieces of a sweep.

    Of several lines of one stop the median of each ray is taken. Stops one after another at one tilt are one sweep.

    Returns:
        The sweeps, and for each piece the one that it belongs to.

    Raises:
        FormatError: if a piece is damaged or not that of a sweep.
    """
    sweeps: list[LineSweep] = []
    owner: list[int] = []
    stops: list[Mapping[str, NDArray[Any]]] = []

    def finish() -> None:
        if stops:
            sweeps.append(_at_rest(stops))
            stops.clear()

    for number, piece in enumerate(pieces):
        if report is not None:
            report(Progress(number, len(pieces), "reading the lines"))
        arrays = _arrays(piece)
        if "unit_time_s" in arrays:
            finish()
            sweeps.append(_in_motion(arrays))
            owner.append(len(sweeps) - 1)
            continue
        if stops and (
            abs(float(arrays["tilt_rad"]) - float(stops[-1]["tilt_rad"])) > _SAME_TILT_RAD
            or arrays["angles_rad"].shape != stops[-1]["angles_rad"].shape
        ):
            finish()
        stops.append(arrays)
        owner.append(len(sweeps))
    finish()
    return sweeps, owner


def _arrays(piece: ListedPiece) -> dict[str, NDArray[Any]]:
    with reading(piece.path) as file, np.load(file, allow_pickle=False) as archive:
        names = ("ranges", "intensity", "angles_rad", "pan_rad", "tilt_rad", "time_s", "sweep_s")
        track = ("unit_time_s", "unit_pan_rad", "unit_tilt_rad")
        found = {name: archive[name] for name in (*names, *track) if name in archive}
        needed = ("ranges", "angles_rad", "time_s", *track) if "unit_time_s" in found else ("ranges", "angles_rad")
        missing = [name for name in needed if name not in found]
        if missing:
            raise FormatError(f"it contains no {', '.join(missing)}; it is no piece of a sweep")
        ranges, angles = found["ranges"], found["angles_rad"]
        if ranges.ndim != 2 or angles.shape != ranges.shape[1:] or ranges.size > _MAX_VALUES or not len(ranges):
            raise ShapeError(
                f"it has ranges {ranges.shape} and angles {angles.shape}; lines x rays and rays are needed"
            )
        if "intensity" in found and found["intensity"].shape != ranges.shape:
            raise ShapeError(f"its intensities have the shape {found['intensity'].shape}, its ranges {ranges.shape}")
        found.setdefault("pan_rad", np.array(piece.at.pan_rad))
        found.setdefault("tilt_rad", np.array(piece.at.tilt_rad))
        return found


def _at_rest(stops: Sequence[Mapping[str, NDArray[Any]]]) -> LineSweep:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # rays without a return
        ranges = np.stack([np.nanmedian(_positive(stop["ranges"]), axis=0) for stop in stops])
        light = None
        if all("intensity" in stop for stop in stops):
            light = np.stack([np.nanmedian(stop["intensity"], axis=0) for stop in stops]).astype(np.float32)
    return LineSweep(
        ranges.astype(np.float32), light, np.asarray(stops[0]["angles_rad"], np.float64),
        np.array([float(stop["pan_rad"]) for stop in stops]), np.array([float(stop["tilt_rad"]) for stop in stops]),
    )  # fmt: skip


def _in_motion(arrays: Mapping[str, NDArray[Any]]) -> LineSweep:
    track = UnitTrack(arrays["unit_time_s"], arrays["unit_pan_rad"], arrays["unit_tilt_rad"])
    light = arrays.get("intensity")
    return LineSweep.moving(
        _positive(arrays["ranges"]), light, arrays["angles_rad"], time_s=arrays["time_s"],
        sweep_s=float(arrays.get("sweep_s", 0.0)), track=track,
    )  # fmt: skip


def _positive(ranges: NDArray[Any]) -> NDArray[np.float32]:
    values = np.asarray(ranges, np.float32)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(values) & (values > 0), values, np.float32(np.nan))
