"""Panoramas: the pieces of a run on a pan/tilt unit as one scan, which every other command reads."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial as bound
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.version import VERSION

if TYPE_CHECKING:
    from ladarreg_core.acquisition.alignment.refined_pieces import Refinement
    from ladarreg_core.acquisition.runs.piece_list import PieceList
    from ladarreg_core.frames import Rigid
    from ladarreg_core.scan import Scan

PANORAMA_IS = (
    "scan.npz is in the world of the pan/tilt unit: its origin is where the axes cross, X ahead at pan 0, Y left, Z "
    "along the pan axis, m"
)
"""Explanation of a panorama's frame, written into `panorama.json`."""
LEVELLED_IS = (
    "scan.npz is level: its origin is where the axes of the pan/tilt unit cross, its axes are those of the unit turned "
    "by mount.base, Z up, m"
)
"""The same of a unit that hangs or leans."""
PROVENANCE_IS = (
    "provenance.png has the grid of scan.npz and shows by the color of each piece which one a cell is from; black = no "
    "return. Up to 255 pieces: an indexed image, its values are the places in pieces, or of a sweep the numbers of the "
    "sweeps, and 255 = no return"
)
"""Explanation of the picture of the pieces, written into `panorama.json`."""
_VERSION = 1
_MAX_LISTED = 8


@dataclass(frozen=True, slots=True, eq=False)
class Panorama:
    """A panorama and how it was made."""

    scan: Scan
    """The scan, in the world of the unit."""
    piece_of_cell: NDArray[np.int16]
    """(H, W) the place in `fields["pieces"]` of the piece that each return is from, or the number of its sweep;
    -1 = no return."""
    fields: Mapping[str, Any]
    """Contents of `panorama.json`."""

    @property
    def accepted(self) -> bool:
        """Whether its pieces fit, and the run has closed as far as that was looked at."""
        return not self.reasons

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not accepted."""
        return tuple(self.fields["reasons"])


def compose(
    run_folder: str | Path,
    *,
    mount: Rigid | None = None,
    base: Rigid | None = None,
    base_sigma_deg: tuple[float, float] | None = None,
    calibrate_mount: bool = False,
    refine: bool = False,
    partial: bool = False,
    report: Report | None = None,
) -> Panorama:
    """Return the panorama of a run, level where the plan says how the unit stands or hangs.

    Args:
        run_folder: folder of a run, or a CSV with `file,pan_deg,tilt_deg` of scans in any format that can be read.
        mount: `unit_from_scanner`; None: that of the plan, or of a list without a plan the scanner at the crossing of
            the axes.
        base: `level_from_unit`, a rotation; None: that of the plan, else upright.
        base_sigma_deg: standard deviations of its roll and pitch, which become the covariance of the panorama's level;
            None: those of the plan, if its base is used.
        calibrate_mount: estimate the mount from surfaces that were seen twice.
        refine: refine the pieces of a mosaic against each other.
        partial: compose what is there of a run that is not complete.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        FormatError: if the folder is not that of a run, a piece is missing or is not the one recorded, or the run is
            not complete.
        ShapeError: if there is nothing to compose.
        OptionError: if the options do not suit the run.
    """
    from ladarreg_core.acquisition.runs.piece_list import read_piece_list
    from ladarreg_core.frames import Rigid

    listed = read_piece_list(run_folder)
    if listed.missing and not partial:
        raise FormatError(
            f"the run is not complete: {len(listed.missing)} of {listed.planned} pieces are missing "
            f"({_some(listed.missing)}); resume it, or compose what is there by `partial=True`"
        )
    checksums = []
    for number, piece in enumerate(listed.pieces):
        if report is not None:
            report(Progress(number, len(listed.pieces), "checking the pieces"))
        checksums.append(piece.checked_sha256())
    start = mount if mount is not None else listed.mount
    origin = "given" if mount is not None else "plan" if listed.mount is not None else "none: the scanner's own centre"
    level = base or listed.base or Rigid.identity()
    sigma_deg = base_sigma_deg or (listed.base_sigma_deg if base is None else None)
    if listed.mode == "sweep":
        if refine:
            raise OptionError("a sweep has no pieces to refine; leave `refine` out, or use `calibrate_mount`")
        made = _sweep(listed, start, level, calibrate_mount=calibrate_mount, report=report)
    else:
        made = _mosaic(listed, start, level, calibrate_mount=calibrate_mount, refine=refine, report=report)
    return replace(made, fields=_document(listed, made, checksums, origin, level, sigma_deg))


def _mosaic(
    listed: PieceList, mount: Rigid | None, level: Rigid, *, calibrate_mount: bool, refine: bool, report: Report | None
) -> Panorama:
    from ladarreg_core.acquisition.alignment.mosaic_piece import PlacedPiece
    from ladarreg_core.acquisition.composition.mosaic_composition import compose_mosaic
    from ladarreg_core.acquisition.mount_fields import is_upright, mount_as_fields
    from ladarreg_core.formats import read_scan
    from ladarreg_core.frames import Rigid
    from ladarreg_core.scanner.pan_tilt import pan_tilt_pose

    held = mount or Rigid.identity()
    pieces = [
        PlacedPiece(
            bound(read_scan, piece.path),
            pan_tilt_pose(piece.at.pan_rad, piece.at.tilt_rad, unit_from_scanner=held),
            piece.path.name,
        )
        for piece in listed.pieces
    ]
    found = None
    if calibrate_mount or refine:
        from ladarreg_core.acquisition.alignment.piece_refinement import refine_pieces

        at = [piece.at for piece in listed.pieces]
        found = refine_pieces(pieces, at, mount=held, calibrate_mount=calibrate_mount, refine=refine, report=report)
        held = found.mount
        pieces = [
            replace(piece, world_from_scanner=one.world_from_scanner)
            for piece, one in zip(pieces, found.pieces, strict=True)
        ]
    if not is_upright(level):
        pieces = [replace(piece, world_from_scanner=level @ piece.world_from_scanner) for piece in pieces]
    made = compose_mosaic(pieces, name=listed.source.stem, report=report)
    counts = {
        "overlapping": made.overlapping,
        "disagreeing": made.disagreeing,
        "folded": made.folded,
    }
    each = [
        {"returns": one.returns, "shown": one.shown, "outdone": one.outdone, "folded": one.folded}
        for one in made.pieces
    ]
    fit = made.fit.as_fields()
    reasons = []
    if made.fit.first_misfit is not None:
        fit["first_misfit"] = listed.pieces[made.fit.first_misfit].index
        reasons.append(made.fit.sentence(fit["first_misfit"]))
    fields: dict[str, Any] = {
        "mount": mount_as_fields(held), "counts": counts, "each": each, "fit": fit, "reasons": reasons,
    }  # fmt: skip
    if found is not None:
        _state_refinement(fields, found, calibrated=calibrate_mount)
    return Panorama(made.scan, made.piece_of_cell, fields)


def _state_refinement(fields: dict[str, Any], found: Refinement, *, calibrated: bool) -> None:
    """Add what a refinement found to the fields of a mosaic."""
    from ladarreg_core.acquisition.alignment.refined_pieces import PARAMETERS

    for each, one in zip(fields["each"], found.pieces, strict=True):
        each["refinement"] = {
            "state": one.state, "pan_tilt_roll_deg": list(one.turn_deg), "shift_mm": math.hypot(*one.shift_scanner_mm),
            "sigma_pan_tilt_deg": list(one.sigma_deg), "weak": list(one.weak), "knocked": one.knocked,
            "points": one.points,
        }  # fmt: skip
    fields["refinement"] = {
        "accepted": found.accepted, "planes": found.planes, "noise_mm": 1000 * found.noise_m,
        "held_out_before_mm": 1000 * found.held_out_before_m, "held_out_after_mm": 1000 * found.held_out_after_m,
    }  # fmt: skip
    fields["notes"] = list(found.reasons)
    if calibrated and found.mount_covariance is not None:
        sigma = np.sqrt(np.diag(found.mount_covariance))
        fields["mount"] |= _mount_report(PARAMETERS, sigma, found.mount_determined)


def _mount_report(names: Sequence[str], sigma: NDArray[np.float64], determined: Sequence[bool]) -> dict[str, Any]:
    """Return the standard deviations of a mount in mm and degrees, and what is not determined."""
    units = {"x": ("x_mm", 1e3), "y": ("y_mm", 1e3), "z": ("z_mm", 1e3), "latency": ("latency_ms", 1e3)}
    stated = {}
    for name, value, known in zip(names, sigma, determined, strict=True):
        label, scale = units.get(name, (f"{name}_deg", float(np.degrees(1))))
        stated[label] = scale * float(value) if known else None
    lost = [name for name, known in zip(names, determined, strict=True) if not known]
    return {"from": "estimated", "sigma": stated, "not_determined": lost}


def _sweep(
    listed: PieceList, mount: Rigid | None, level: Rigid, *, calibrate_mount: bool, report: Report | None
) -> Panorama:
    from ladarreg_core.acquisition.alignment import mount_calibration
    from ladarreg_core.acquisition.composition.sweep_composition import compose_sweeps
    from ladarreg_core.acquisition.mount_fields import is_upright, mount_as_fields
    from ladarreg_core.acquisition.runs.sweep_pieces import read_sweeps

    if mount is None:
        raise OptionError("the run has no plan with a mount; give `mount`, which also stands a line scanner upright")
    sweeps, sweep_of_piece = read_sweeps(listed.pieces, report=report)
    latency_s = 0.0
    calibration: dict[str, Any] = {}
    if calibrate_mount:
        found = mount_calibration.calibrate_mount(sweeps, mount, report=report)
        mount, latency_s = found.unit_from_scanner, found.latency_s
        calibration = {"calibration": found.as_fields()} | ({"from": "estimated"} if found.accepted else {})
    turned = None if is_upright(level) else level
    made = compose_sweeps(sweeps, mount, turned, latency_s=latency_s, name=listed.source.stem)
    counts = {"folded": made.folded, "repeated": made.repeated}
    fields = {
        "mount": {**mount_as_fields(mount), **calibration}, "counts": counts,
        "columns_are_lines": made.columns_are_lines,
        "each": [{"sweep": sweep} for sweep in sweep_of_piece],
    }  # fmt: skip
    return Panorama(made.scan, made.sweep_of_cell, fields)


def _document(
    listed: PieceList, made: Panorama, checksums: Sequence[str], mount_from: str, level: Rigid,
    base_sigma_deg: tuple[float, float] | None,
) -> dict[str, Any]:  # fmt: skip
    """Return the fields of `panorama.json`."""
    from ladarreg_core.acquisition.mount_fields import (
        BASE_IS,
        LEAN_IS,
        MOUNT_IS,
        base_as_value,
        is_upright,
        lean_covariance,
    )

    own = dict(made.fields)
    each = own.pop("each")
    rows, columns = made.scan.shape
    counts = {"rows": rows, "columns": columns, "returns": int(made.scan.valid.sum()), **own.pop("counts")}
    mount = {"is": MOUNT_IS, "from": mount_from, **own.pop("mount")}
    frame = PANORAMA_IS
    if not is_upright(level):
        frame = LEVELLED_IS
        mount |= {"base": base_as_value(level), "base_is": BASE_IS}
    if base_sigma_deg is not None:
        lean = lean_covariance(level, base_sigma_deg)
        mount |= {"base_sigma_deg": list(base_sigma_deg), "level_covariance": lean.tolist(), "level_is": LEAN_IS}
    reasons = own.pop("reasons", [])
    if listed.closure is not None and not listed.closure["closed"]:
        reasons = [*reasons, listed.closure["said"]]
    numbers = [more.get("sweep", place) for place, more in enumerate(each)]
    colors = _colors(numbers)
    pieces = [
        {
            "index": piece.index, "file": piece.path.name, "sha256": checksum,
            "pan_deg": float(np.degrees(piece.at.pan_rad)), "tilt_deg": float(np.degrees(piece.at.tilt_rad)),
            "color": "#" + colors[number].tobytes().hex(), **more,
        }
        for piece, checksum, number, more in zip(listed.pieces, checksums, numbers, each, strict=True)
    ]  # fmt: skip
    return {
        "version": _VERSION, "kind": "panorama", "software": {"name": "ladarreg", "version": VERSION},
        "mode": listed.mode, "scan": "scan.npz", "frame_is": frame, "provenance": "provenance.png",
        "provenance_is": PROVENANCE_IS, "accepted": not reasons, "reasons": reasons, "counts": counts, "mount": mount,
        "closure": None if listed.closure is None else dict(listed.closure), **own,
        "notes": [*made.scan.notes, *own.get("notes", ())], "missing": list(listed.missing), "pieces": pieces,
    }  # fmt: skip


def _colors(numbers: Sequence[int]) -> NDArray[np.uint8]:
    """Return the colours (N, 3) of the pieces, or of the sweeps, with these numbers."""
    from ladarreg_core.foundations.palette import distinct_colors

    return distinct_colors(max(numbers, default=-1) + 1)


def write_panorama(
    folder: str | Path,
    panorama: Panorama,
    *,
    poses: Mapping[str, Rigid] | None = None,
    inputs: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write `scan.npz`, `panorama.json` and `provenance.png` into a new folder, all at once.

    Args:
        folder: output folder.
        panorama: what to write.
        poses: `camera_from_scanner` of photographs, by the names of their files `poses/NAME.json`.
        inputs: the run's folder or list, which must not be replaced.
        force: replace an earlier panorama and nothing else.
        report: receives the progress.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    from ladarreg_core.export.json import write_document
    from ladarreg_core.export.targets.folder import write_folder
    from ladarreg_core.formats.documents.pose_file import write_pose

    placed = poses or {}
    write_folder(
        folder,
        lambda: [
            ("scan.npz", lambda path: _write_scan(path, panorama)),
            ("panorama.json", lambda path: write_document(path, panorama.fields)),
            ("provenance.png", lambda path: _write_provenance(path, panorama)),
            *((f"poses/{name}.json", bound(write_pose, camera_from_scanner=pose)) for name, pose in placed.items()),
        ],
        inputs=inputs, force=force, report=report,
    )  # fmt: skip


def add_to_run(run_folder: str | Path, panorama: Panorama) -> None:
    """Write `scan.npz`, `panorama.json` and `provenance.png` beside a run's pieces, all or none.

    Raises:
        ExportError: if they cannot be written, would replace foreign files, or another program has the run open.
    """
    from ladarreg_core.acquisition.runs.earlier_run import add_panorama
    from ladarreg_core.export.json import write_document

    add_panorama(
        Path(run_folder),
        {
            "scan.npz": lambda path: _write_scan(path, panorama),
            "provenance.png": lambda path: _write_provenance(path, panorama),
            "panorama.json": lambda path: write_document(path, panorama.fields),
        },
    )


def _write_scan(path: Path, panorama: Panorama) -> None:
    from ladarreg_core.formats.scans.npz import write_npz_panorama, write_npz_xyz
    from ladarreg_core.scanner.grids import SphericalGrid

    note = f"not accepted: {'; '.join(panorama.reasons)}" if panorama.reasons else ""
    if isinstance(panorama.scan.geometry, SphericalGrid):
        write_npz_panorama(path, panorama.scan, piece=panorama.piece_of_cell, note=note)
    else:
        write_npz_xyz(path, panorama.scan, note=note)


def _write_provenance(path: Path, panorama: Panorama) -> None:
    from ladarreg_core.export.pictures.images import write_provenance_png

    numbers = [piece.get("sweep", place) for place, piece in enumerate(panorama.fields["pieces"])]
    write_provenance_png(path, panorama.piece_of_cell, _colors(numbers))


def _some(indices: Sequence[int]) -> str:
    shown = ", ".join(map(str, indices[:_MAX_LISTED]))
    return shown if len(indices) <= _MAX_LISTED else f"{shown} and {len(indices) - _MAX_LISTED} more"


def mount_of_text(text: str) -> Rigid:
    """Return `unit_from_scanner` of `x,y,z,roll,pitch,yaw` (m, deg), or of a JSON file that states it.

    Raises:
        OptionError: if it is neither.
        FormatError: if the file states no mount.
    """
    from ladarreg_core.acquisition.mount_fields import mount_from_fields
    from ladarreg_core.formats.parsing.json_file import read_json_object
    from ladarreg_core.formats.parsing.untrusted import one_line, reading

    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 6:
        try:
            numbers = [float(part) for part in parts]
        except ValueError:
            numbers = []
        if numbers and np.isfinite(numbers).all():
            return mount_from_fields({"xyz_m": numbers[:3], "rpy_deg": numbers[3:]})
    if len(parts) > 1 or not Path(text).exists():
        raise OptionError(
            f"the mount {one_line(text, 80)!r} is neither a file nor six numbers: x,y,z in metres, roll,pitch,yaw in "
            "degrees"
        )
    with reading(text) as file:
        fields = read_json_object(file, "a mount")
        return mount_from_fields(fields.get("mount", fields))


def describe_run(folder: str | Path) -> dict[str, Any]:
    """Return what a run folder contains, in words, by name.

    Raises:
        FormatError: if it is not the folder of a run.
    """
    from ladarreg_core.acquisition.mount_fields import mount_as_fields
    from ladarreg_core.acquisition.runs.piece_list import read_piece_list
    from ladarreg_core.foundations.shell_command import shell_command

    listed = read_piece_list(folder)
    pans, tilts = (np.degrees([getattr(piece.at, name) for piece in listed.pieces]) for name in ("pan_rad", "tilt_rad"))
    planned = "" if listed.planned is None else f" of {listed.planned}"
    return {
        "file": Path(folder).resolve().name,
        "kind": "run",
        "mode": listed.mode,
        "pieces": f"{len(listed.pieces)}{planned}",
        "missing": _some(listed.missing) if listed.missing else None,
        "pan_deg": [round(float(pans.min()), 4), round(float(pans.max()), 4)],
        "tilt_deg": [round(float(tilts.min()), 4), round(float(tilts.max()), 4)],
        "mount": None if listed.mount is None else mount_as_fields(listed.mount),
        "next": shell_command(["ladarreg", "panorama", Path(folder).resolve().name, "-o", "OUT"])
        if not listed.missing
        else "resume the run, or `ladarreg panorama --partial`",
    }
