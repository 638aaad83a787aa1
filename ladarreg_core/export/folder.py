"""Everything that a registration gives, in one folder that is there wholly or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from ladarreg_core.errors import ExportError
from ladarreg_core.export.atomic_write import cannot_write, sync_folder
from ladarreg_core.export.glb import write_glb
from ladarreg_core.export.images import write_labels_png, write_registered_png
from ladarreg_core.export.json import write_document
from ladarreg_core.export.ply import write_ply
from ladarreg_core.export.registration_json import registration_document
from ladarreg_core.export.replacement import REGISTRATION_FILES, in_words, require_apart, require_replaceable
from ladarreg_core.export.staging import clear_leftovers, put_in_place, staging_folder
from ladarreg_core.export.uncertainty_png import write_uncertainty_png
from ladarreg_core.photo import Photo
from ladarreg_core.progress import Progress, Report
from ladarreg_core.quality.assessment import Assessment, assess
from ladarreg_core.quality.smoothing import SmoothedScan
from ladarreg_core.results import Registration
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh import scan_mesh
from ladarreg_core.surface.texture import RegisteredTexture, model_picture, texture_scan

FILE_NAMES = REGISTRATION_FILES
"""What a folder of results holds; all but the first only where the registration is accepted."""
FileJob = tuple[str, Callable[[Path], None]]
"""A file's name, and what writes it to a path."""


def export_registration(
    folder: str | Path,
    registration: Registration,
    scan: Scan,
    photo: Photo,
    *,
    assessment: Assessment | None = None,
    smoothed: SmoothedScan | None = None,
    inputs: Sequence[str | Path] = (),
    apart_from: Sequence[str | Path] = (),
    more: Sequence[FileJob] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write a registration into a new folder.

    `registration.json` always; `registered.png`, `labels.png`, `uncertainty.png`, `model.glb` and `cloud.ply` only if
    the registration is accepted. The folder is there wholly or not at all, as `write_folder` says.

    Args:
        folder: where to; its parents are made if need be.
        registration: the result.
        scan: the scan.
        photo: the photograph.
        assessment: what there is to say of it; None: it is assessed here.
        smoothed: the scan that `model.glb` and `cloud.ply` show; None: the scan itself.
        inputs: the files that scan and photo came from, named in `registration.json`.
        apart_from: as in `write_folder`.
        more: further files, as the matches that were drawn.
        force: replace the results of an earlier run.
        report: told after each file.

    Raises:
        ExportError: if the folder exists and must not be replaced, as `check_folder` says, or if something cannot be
            written.
    """
    write_folder(
        folder,
        lambda: [*registration_files(registration, scan, photo, inputs, assessment, smoothed), *more],
        inputs=inputs,
        apart_from=apart_from,
        more_names=[name for name, _ in more],
        force=force,
        report=report,
    )


def write_folder(
    folder: str | Path,
    files: Callable[[], Sequence[FileJob]],
    *,
    inputs: Sequence[str | Path] = (),
    apart_from: Sequence[str | Path] = (),
    more_names: Collection[str] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write files into a new folder that is there wholly or not at all.

    All is written beside the folder's place and put into it in one step at the end, so that an error, an interruption
    or a `report` that raises leaves what was there before. What a killed program left beside it is cleared away first.

    Args:
        folder: where to; its parents are made if need be.
        files: returns the names and writers; called when the folder can be written.
        inputs: the files that the results come from; a folder that holds one of them is not replaced.
        apart_from: folders of projects that are open; none that is, holds or lies in one of them is replaced.
        more_names: files of such folders, beside those that every run writes.
        force: replace the results of an earlier run.
        report: told before each file and at the end.

    Raises:
        ExportError: if the folder exists and must not be replaced, as `check_folder` says, or if something cannot be
            written.
    """
    check_folder(folder, force=force, inputs=inputs, apart_from=apart_from, more_names=more_names)
    target = _place_of(folder)
    made = _missing_parents(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with staging_folder(target, more_names=more_names) as new:
            _write_all(new, files(), report)
            _sync(new)
            _require_free(target, force, inputs, apart_from, more_names)  # it may have appeared meanwhile
            put_in_place(
                new,
                target,
                lambda old: require_replaceable(old, force=force, more_names=more_names, shown=target),
            )
    except OSError as error:
        raise cannot_write(in_words(target), error) from None
    finally:
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()  # where nothing came into it


def check_folder(
    folder: str | Path,
    *,
    force: bool = False,
    inputs: Sequence[str | Path] = (),
    apart_from: Sequence[str | Path] = (),
    more_names: Collection[str] = (),
) -> None:
    """Refuse a folder that results must not go to; call it before long work.

    A folder that exists is replaced only if `force` is on and it holds the results of an earlier run and nothing else
    (an empty one, too); without `force` only if these are of a registration that was refused. A project, the folder
    of an input, and what is above or below them is never replaced. What a killed program left beside the folder is
    cleared away: a folder that it had set aside has its name back.

    Args:
        folder: where results are to go.
        force: whether results may be replaced.
        inputs: as in `write_folder`.
        apart_from: as in `write_folder`.
        more_names: as in `write_folder`.

    Raises:
        ExportError: if that is so, if it is not a folder, or if none can be made there.
    """
    try:
        target = _place_of(folder)
        clear_leftovers(target.parent, more_names=more_names)
        _require_free(target, force, inputs, apart_from, more_names)
    except (OSError, ValueError) as error:  # a name that is too long, or holds a NUL
        reason = (getattr(error, "strerror", None) or str(error)).lower()
        raise ExportError(f"{in_words(folder)} cannot be a folder: {reason}; give another place") from None


def _require_free(
    target: Path,
    force: bool,
    inputs: Sequence[str | Path],
    apart_from: Sequence[str | Path],
    more_names: Collection[str],
) -> None:
    shown = in_words(target)
    if not target.name:
        raise ExportError(f"{shown} is the top of a file system; give a folder below it")
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        os.lstat(target)  # raises for names that no system takes
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        what = "a symbolic link" if target.is_symlink() else "no folder"
        raise ExportError(f"{shown} exists and is {what}; give another place for the results")
    if target.exists():
        here = Path.cwd()
        if any(os.path.samefile(target, parent) for parent in (here, *here.parents)):
            raise ExportError(f"the folder {shown} is the one you work in; give another place for the results")
        require_apart(target, inputs=inputs, projects=apart_from)
        require_replaceable(target, force=force, more_names=more_names)
    home = next(parent for parent in (*target.parents, target) if os.path.lexists(parent))
    if not home.is_dir() or not os.access(home, os.W_OK | os.X_OK):
        reason = "may not be written to" if home.is_dir() else "is no folder"
        raise ExportError(f"{shown} cannot be made: {in_words(home)} {reason}; give another place for the results")


def _place_of(folder: str | Path) -> Path:
    """Return a folder's place with all links above it followed, as the system does it; its own name stays."""
    path = Path(folder)
    if path.name in ("", ".."):
        return Path(os.path.realpath(path))
    return Path(os.path.realpath(path.parent), path.name)


def _sync(folder: Path) -> None:
    """Have the disk hold every file of a folder before the folder takes the place of another."""
    for path in folder.iterdir():
        with open(path, "rb+") as file:
            os.fsync(file.fileno())
    sync_folder(folder)


def _write_all(folder: Path, jobs: Sequence[FileJob], report: Report | None) -> None:
    for done, (name, write) in enumerate(jobs):
        if report is not None:
            report(Progress(done, len(jobs), f"writing {name}"))
        write(folder / name)
    if report is not None:
        report(Progress(len(jobs), len(jobs), "written"))


def registration_files(
    registration: Registration,
    scan: Scan,
    photo: Photo,
    inputs: Sequence[str | Path] = (),
    assessment: Assessment | None = None,
    smoothed: SmoothedScan | None = None,
) -> list[FileJob]:
    """Return the names of a registration's files, and what writes each; the arguments are `export_registration`'s."""
    found = assess(scan, registration) if assessment is None else assessment

    def write_json(path: Path) -> None:
        write_document(path, registration_document(registration, assessment=found, smoothed=smoothed, inputs=inputs))

    jobs: list[FileJob] = [("registration.json", write_json)]
    if not registration.accepted:
        return jobs
    texture = _textured(registration, scan, photo)
    jobs += [
        ("registered.png", lambda path: write_registered_png(path, texture)),
        ("labels.png", lambda path: write_labels_png(path, texture)),
    ]
    if (uncertainty := found.uncertainty) is not None:
        jobs.append(("uncertainty.png", lambda path: write_uncertainty_png(path, uncertainty.sigma_px)))
    if smoothed is None or smoothed.scan is scan:
        return jobs + _models(scan, texture)
    return jobs + _models(smoothed.scan, _textured(registration, smoothed.scan, photo))


def _textured(registration: Registration, scan: Scan, photo: Photo) -> RegisteredTexture:
    return texture_scan(
        scan,
        photo,
        registration.camera_from_scanner,
        camera=registration.camera,
        covariance=registration.covariance,
    )


def _models(scan: Scan, texture: RegisteredTexture) -> list[FileJob]:
    return [
        ("model.glb", lambda path: write_glb(path, scan_mesh(scan), model_picture(scan, texture))),
        ("cloud.ply", lambda path: write_ply(path, scan, texture)),
    ]


def _missing_parents(target: Path) -> list[Path]:
    """Return the parents that writing will have to make, innermost first."""
    missing = []
    for parent in target.parents:
        if parent.exists():
            break
        missing.append(parent)
    return missing
