"""Export of a registration into a folder that is written atomically."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import ExportError
from ladarreg_core.export.clouds.ply import write_ply
from ladarreg_core.export.json import InputFile, registration_document, write_result
from ladarreg_core.export.models.glb import write_model_glb
from ladarreg_core.export.output_frame import FrameName, OutputFrame
from ladarreg_core.export.pictures.images import (
    write_labels_png,
    write_registered_png,
    write_uncertainty_png,
    write_visibility_png,
)
from ladarreg_core.export.pictures.rejected_overlay import write_rejected_overlay
from ladarreg_core.export.report.page import write_report
from ladarreg_core.foundations.parallel import OtherCore, side_by_side
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.photo import Photo
from ladarreg_core.quality.assessment import Assessment, assess
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan
from ladarreg_core.storage.atomic_write import cannot_write, make_folder, sync_tree
from ladarreg_core.storage.manifest import write_manifest
from ladarreg_core.storage.replacement import (
    OFFSET_FILE,
    OVERLAY_FILE,
    REGISTRATION_FILES,
    REPORT_FILE,
    display_path,
    require_apart,
    require_replaceable,
)
from ladarreg_core.storage.staging import clear_leftovers, put_in_place, staging_folder
from ladarreg_core.surface.texture.photo_model import ModelPhoto, photo_model
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture, intensity_picture, texture_scan
from ladarreg_core.surface.visibility.occluding_surface import occluding_surface

if TYPE_CHECKING:
    from ladarreg_core.quality.smoothing import SmoothedScan

FILE_NAMES = REGISTRATION_FILES
"""Files of a results folder; all but the first two are only written for accepted registrations."""
MAX_CELLS_TOGETHER = 4_000_000
"""Cells of a scan up to which two files are written at a time; of larger ones the memory matters more than the time."""
_MAX_CELLS_AHEAD = 2_000_000
FileJob = tuple[str, Callable[[Path], None]]
"""File name, with `/` between folders, and the function that writes the file to a path."""


def export_registration(
    folder: str | Path,
    registration: Registration,
    scan: Scan,
    photo: Photo,
    *,
    assessment: Assessment | None = None,
    smoothed: SmoothedScan | None = None,
    inputs: Sequence[str | Path] = (),
    read_with: Sequence[Mapping[str, Any]] = (),
    apart_from: Sequence[str | Path] = (),
    more: Sequence[FileJob] = (),
    frame: FrameName = "scanner",
    open_command: str | None = None,
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write a registration into a new folder.

    `registration.json` and `report.html` always; `rejected_overlay.png` if it is refused; `registered.png`,
    `labels.png`, `visibility.png`, `uncertainty.png`, `model.glb` and `cloud.ply` (in the world with `offset.json`)
    only if the registration is accepted, or its pose was given: then they are marked so. The folder is written
    atomically, see `write_folder`.

    Args:
        folder: output folder; missing parents are created.
        registration: the result.
        scan: the scan.
        photo: the photograph.
        assessment: assessment of the result; None: it is computed here.
        smoothed: the scan used for `model.glb` and `cloud.ply`; None: `scan`.
        inputs: the files that scan and photo were read from, recorded in `registration.json`; empty: those that
            `read_scan` and `read_photo` read them from, as far as they are still there.
        read_with: the options that they were read with, see `json.input_documents`; recorded, too.
        apart_from: as in `write_folder`.
        more: additional files, such as the picks.
        frame: of `model.glb` and `cloud.ply`; in the world, `offset.json` states what was subtracted.
        open_command: the command that opens a refused case in the workbench, stated in its document and report.
        force: replace the results of an earlier run.
        report: receives the progress, per file.

    Raises:
        OptionError: if the frame is `world` and the scan does not state where it stands.
        ExportError: if the folder exists and must not be replaced, see `check_folder`, or if something cannot be
            written.
    """
    if not inputs:
        inputs, read_with = _read_from(scan, photo)
    write_folder(
        folder,
        lambda: [
            *registration_files(
                registration,
                scan,
                photo,
                inputs,
                assessment,
                smoothed,
                read_with=read_with,
                frame=frame,
                open_command=open_command,
                folder=_resolve_parent(folder),
            ),
            *more,
        ],
        inputs=inputs,
        apart_from=apart_from,
        more_names=[name for name, _ in more],
        force=force,
        together=scan.ranges.size <= MAX_CELLS_TOGETHER,
        report=report,
    )


def _read_from(scan: Scan, photo: Photo) -> tuple[list[Path], list[Mapping[str, Any]]]:
    """Return the files that scan and photograph were read from, and the options; empty where one of both is gone."""
    if scan.source is None or photo.source is None:
        return [], []
    (first, *more), (picture, *camera) = scan.source.files, photo.source.files
    files = [first, picture, *camera, *more]
    if not all(path.is_file() for path in files):
        return [], []
    return files, [scan.source.options, *([photo.source.options] if photo.source.options else [])]


def prepare_export(scan: Scan) -> None:
    """Compute what the assessment and the files of any pose of a scan need, to be called while the pose is sought.

    Of a large scan, nothing is computed, since the memory for both at once matters more.
    """
    if scan.ranges.size <= _MAX_CELLS_AHEAD:
        occluding_surface(scan)
        intensity_picture(scan)


def write_folder(
    folder: str | Path,
    files: Callable[[], Sequence[FileJob]],
    *,
    inputs: Sequence[str | Path] = (),
    apart_from: Sequence[str | Path] = (),
    more_names: Collection[str] = (),
    force: bool = False,
    together: bool = False,
    report: Report | None = None,
) -> None:
    """Write files into a new folder atomically.

    Their manifest is written with them, all to a temporary folder next to the target, which is renamed at the end, so
    that an error, an interruption or a `report` that raises leaves the previous state. Leftovers of killed programs are
    removed first.

    Args:
        folder: output folder; missing parents are created.
        files: returns the names and writers; called once the folder can be written.
        inputs: the input files of the results; a folder that contains one of them is not replaced.
        apart_from: open project folders; a folder that is, contains or lies in one of them is not replaced.
        more_names: names of additional result files, beyond those that every run writes.
        force: replace the results of an earlier run.
        together: whether two files may be written at a time, which needs the memory for both.
        report: receives the progress, before each file and at the end.

    Raises:
        ExportError: if the folder exists and must not be replaced, see `check_folder`, or if something cannot be
            written.
    """
    check_folder(folder, force=force, inputs=inputs, apart_from=apart_from, more_names=more_names)
    target = _resolve_parent(folder)
    made = _missing_parents(target)
    try:
        make_folder(target.parent)
        with staging_folder(target, more_names=more_names) as new:
            _write_all(new, files(), report, together=together)
            write_manifest(new)
            sync_tree(new)  # before it replaces another
            _require_free(target, force, inputs, apart_from, more_names)  # it may have been created meanwhile
            put_in_place(
                new,
                target,
                lambda old: require_replaceable(old, force=force, more_names=more_names, shown=target),
            )
    except OSError as error:
        raise cannot_write(display_path(target), error) from None
    finally:
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()  # only if still empty


def check_folder(
    folder: str | Path,
    *,
    force: bool = False,
    inputs: Sequence[str | Path] = (),
    apart_from: Sequence[str | Path] = (),
    more_names: Collection[str] = (),
) -> None:
    """Refuse a folder that must not be used for results; to be called before long computations.

    With `force`, an existing folder is replaced if it is empty or contains only results of an earlier run; without
    `force`, only if these are of a registration that was refused. A project, the folder of an input, and folders above
    or below them are never replaced. Leftovers of a killed program are removed, and a folder that it had renamed gets
    its name back.

    Args:
        folder: output folder.
        force: whether results may be replaced.
        inputs: as in `write_folder`.
        apart_from: as in `write_folder`.
        more_names: as in `write_folder`.

    Raises:
        ExportError: if the folder must not be replaced, is not a folder, or cannot be created.
    """
    try:
        target = _resolve_parent(folder)
        clear_leftovers(target.parent, more_names=more_names)
        _require_free(target, force, inputs, apart_from, more_names)
    except (OSError, ValueError) as error:  # a name that is too long or contains a NUL
        reason = (getattr(error, "strerror", None) or str(error)).lower()
        raise ExportError(f"{display_path(folder)} cannot be a folder: {reason}; give another folder") from None


def _require_free(
    target: Path,
    force: bool,
    inputs: Sequence[str | Path],
    apart_from: Sequence[str | Path],
    more_names: Collection[str],
) -> None:
    shown = display_path(target)
    if not target.name:
        raise ExportError(f"{shown} is the root of a file system; give a folder below it")
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        os.lstat(target)  # raises for invalid names
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        what = "a symbolic link" if target.is_symlink() else "not a folder"
        raise ExportError(f"{shown} exists and is {what}; give another folder for the results")
    if target.exists():
        here = Path.cwd()
        if any(os.path.samefile(target, parent) for parent in (here, *here.parents)):
            raise ExportError(f"the folder {shown} is the current working folder; give another folder for the results")
        require_apart(target, inputs=inputs, projects=apart_from)
        require_replaceable(target, force=force, more_names=more_names)
    home = next(parent for parent in (*target.parents, target) if os.path.lexists(parent))
    if not home.is_dir() or not os.access(home, os.W_OK | os.X_OK):
        reason = "is not writable" if home.is_dir() else "is not a folder"
        raise ExportError(f"{shown} cannot be created: {display_path(home)} {reason}; give another folder")


def _resolve_parent(folder: str | Path) -> Path:
    """Return a folder's path with the symbolic links above it resolved, but not the folder itself."""
    path = Path(folder)
    if path.name in ("", ".."):
        return Path(os.path.realpath(path))
    return Path(os.path.realpath(path.parent), path.name)


def _write_all(folder: Path, jobs: Sequence[FileJob], report: Report | None, *, together: bool) -> None:
    def tell(done: int) -> None:
        if report is not None:
            report(Progress(done, len(jobs), f"writing {jobs[done][0]}"))

    def write_one(job: FileJob) -> None:
        name, write = job
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write(folder / name)

    if together:
        side_by_side(write_one, jobs, before=tell)
    else:
        for done, job in enumerate(jobs):
            tell(done)
            write_one(job)
    if report is not None:
        report(Progress(len(jobs), len(jobs), "written"))


def registration_files(
    registration: Registration,
    scan: Scan,
    photo: Photo,
    inputs: Sequence[InputFile] = (),
    assessment: Assessment | None = None,
    smoothed: SmoothedScan | None = None,
    *,
    read_with: Sequence[Mapping[str, Any]] = (),
    frame: FrameName = "scanner",
    open_command: str | None = None,
    folder: Path | None = None,
    saved_document: Callable[[], Mapping[str, Any]] | None = None,
) -> list[FileJob]:
    """Return the names and writers of a registration's files; the arguments are those of `export_registration`.

    `folder` is where they are put; None: that is not known, as of a zip file. `saved_document` returns the document
    that `registration.json` is to be; None: one is made of the registration.
    """
    placed = OutputFrame.of(scan, frame)
    found = assess(scan, registration) if assessment is None else assessment

    @cache  # hashing the inputs takes longest
    def document() -> dict[str, Any]:
        if saved_document is not None:
            described = dict(saved_document())
        else:
            described = registration_document(
                registration, assessment=found, smoothed=smoothed, inputs=inputs, read_with=read_with, folder=folder
            )
        if registration.is_shown:
            described["models"] = placed.as_dict()
        elif open_command is not None:
            described["open_in_workbench"] = open_command
        return described

    if registration.is_shown:
        with OtherCore() as other_core:  # the document beside the texture
            other_core.begin(document)
            texture = _textured(registration, scan, photo)
    else:
        texture = None
    jobs: list[FileJob] = [
        ("registration.json", lambda path: write_result(path, document())),
        (REPORT_FILE, lambda path: write_report(path, registration, scan, photo, document(), texture=texture)),
    ]
    if texture is None:
        return [*jobs, (OVERLAY_FILE, lambda path: write_rejected_overlay(path, scan, photo, registration))]
    jobs += [
        ("registered.png", lambda path: write_registered_png(path, texture, mark=registration.mark)),
        ("labels.png", lambda path: write_labels_png(path, texture, mark=registration.caveat)),
        ("visibility.png", lambda path: write_visibility_png(path, texture, mark=registration.mark)),
    ]
    if (uncertainty := found.uncertainty) is not None:
        jobs.append(("uncertainty.png", lambda path: write_uncertainty_png(path, uncertainty.sigma_px)))
    if smoothed is None or smoothed.scan is scan:
        return jobs + _models(registration, scan, photo, texture, placed)
    smooth = smoothed.scan
    return jobs + _models(registration, smooth, photo, _textured(registration, smooth, photo), placed)


def _textured(registration: Registration, scan: Scan, photo: Photo) -> RegisteredTexture:
    return texture_scan(
        scan,
        photo,
        registration.camera_from_scanner,
        camera=registration.camera,
        covariance=registration.joint_covariance,
    )


def _models(
    registration: Registration, scan: Scan, photo: Photo, texture: RegisteredTexture, frame: OutputFrame
) -> list[FileJob]:
    mark = registration.caveat

    def write_model(path: Path) -> None:
        seen = ModelPhoto(photo.pixels, registration.camera, registration.camera_from_scanner, texture.labels)
        write_model_glb(path, photo_model(scan, [seen]), frame=frame, names=[photo.name], mark=mark)

    jobs: list[FileJob] = [
        ("model.glb", write_model),
        ("cloud.ply", lambda path: write_ply(path, scan, texture, frame=frame, mark=mark)),
    ]
    return jobs if frame.name == "scanner" else [*jobs, (OFFSET_FILE, frame.write)]


def _missing_parents(target: Path) -> list[Path]:
    """Return the missing parent folders, innermost first."""
    missing = []
    for parent in target.parents:
        if parent.exists():
            break
        missing.append(parent)
    return missing
