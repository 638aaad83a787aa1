"""Everything that a registration gives, in one folder that is there wholly or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from ladarreg_core.assessment import Assessment, assess
from ladarreg_core.errors import ExportError
from ladarreg_core.export.documents import write_document
from ladarreg_core.export.files import cannot_write, sync_folder
from ladarreg_core.export.glb import write_glb
from ladarreg_core.export.images import write_labels_png, write_registered_png
from ladarreg_core.export.ply import write_ply
from ladarreg_core.export.registration_json import registration_document
from ladarreg_core.export.uncertainty_png import write_uncertainty_png
from ladarreg_core.mesh import scan_mesh
from ladarreg_core.photo import Photo
from ladarreg_core.progress import Progress, Report
from ladarreg_core.results import Registration
from ladarreg_core.scan import Scan
from ladarreg_core.smoothed_scan import SmoothedScan
from ladarreg_core.texture import RegisteredTexture, model_picture, texture_scan

FILE_NAMES = ("registration.json", "registered.png", "labels.png", "uncertainty.png", "model.glb", "cloud.ply")
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
        more: further files, as the matches that were drawn.
        force: replace an existing folder, with all that is in it.
        report: told after each file.

    Raises:
        ExportError: if the folder exists and `force` is off, if it holds the inputs, or if something cannot be
            written.
    """
    write_folder(
        folder,
        lambda: [*_registration_files(registration, scan, photo, inputs, assessment, smoothed), *more],
        inputs=inputs,
        own_names=(*FILE_NAMES, *(name for name, _ in more)),
        force=force,
        report=report,
    )


def write_folder(
    folder: str | Path,
    files: Callable[[], Sequence[FileJob]],
    *,
    inputs: Sequence[str | Path] = (),
    own_names: Collection[str] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write files into a new folder that is there wholly or not at all.

    All is written beside the folder's place and renamed into it at the end, so that an error, an interruption or a
    `report` that raises leaves what was there before.

    Args:
        folder: where to; its parents are made if need be.
        files: returns the names and writers; called when the folder can be written.
        inputs: the files that the results come from; a folder that holds one of them is not replaced.
        own_names: names that such folders hold themselves: an earlier result may be an input.
        force: replace an existing folder, with all that is in it.
        report: told before each file and at the end.

    Raises:
        ExportError: if the folder exists and `force` is off, if it holds the inputs, or if something cannot be
            written.
    """
    target = Path(os.path.abspath(folder))
    check_folder(target, force=force)
    _keep_inputs(target, inputs, own_names)
    made = _missing_parents(target)
    aside: Path | None = None
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    begun = False
    try:
        try:
            temporary.mkdir(parents=True)
            begun = True
            _write_all(temporary, files(), report)
            sync_folder(temporary)
            check_folder(target, force=force)  # it may have appeared meanwhile
            if target.exists():
                aside = target.with_name(f".{target.name}.{secrets.token_hex(4)}.old")
                os.rename(target, aside)
            os.rename(temporary, target)
            sync_folder(target.parent)
        except OSError as error:
            raise cannot_write(target, error) from None
    finally:
        if begun and not temporary.exists():  # renamed: an interruption may fall just behind it
            if aside is not None:
                shutil.rmtree(aside, ignore_errors=True)
        else:
            if aside is not None and aside.exists() and not target.exists():
                os.rename(aside, target)
            shutil.rmtree(temporary, ignore_errors=True)
            for parent in made:
                with contextlib.suppress(OSError):
                    parent.rmdir()


def check_folder(folder: str | Path, *, force: bool = False) -> None:
    """Refuse a folder that results must not go to; call it before long work.

    Raises:
        ExportError: if something exists there and `force` is off, if it is not a folder, or if none can be made there.
    """
    path = Path(folder)
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        raise ExportError(f"{path} exists and is no folder; give another place for the results")
    if path.exists() and not force:
        raise ExportError(f"the folder {path} exists; give another one, or --force to replace it")
    if path.exists() and Path.cwd().resolve().is_relative_to(path.resolve()):
        raise ExportError(f"the folder {path} is the one you work in; give another place for the results")
    home = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
    if not home.is_dir() or not os.access(home, os.W_OK | os.X_OK):
        reason = "may not be written to" if home.is_dir() else "is no folder"
        raise ExportError(f"{path} cannot be made: {home} {reason}; give another place for the results")


def _write_all(folder: Path, jobs: Sequence[FileJob], report: Report | None) -> None:
    for done, (name, write) in enumerate(jobs):
        if report is not None:
            report(Progress(done, len(jobs), f"writing {name}"))
        write(folder / name)
    if report is not None:
        report(Progress(len(jobs), len(jobs), "written"))


def _registration_files(
    registration: Registration,
    scan: Scan,
    photo: Photo,
    inputs: Sequence[str | Path],
    assessment: Assessment | None,
    smoothed: SmoothedScan | None,
) -> list[FileJob]:
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


def _keep_inputs(target: Path, inputs: Sequence[str | Path], own_names: Collection[str]) -> None:
    """Refuse to replace the folder that the inputs themselves lie in; an earlier result of ours may be an input."""
    for path in map(Path, inputs):
        if path.resolve().is_relative_to(target.resolve()) and path.name not in own_names:
            raise ExportError(f"the folder {target} holds the input {path.name}; give another place for the results")


def _missing_parents(target: Path) -> list[Path]:
    """Return the parents that writing will have to make, innermost first."""
    missing = []
    for parent in target.parents:
        if parent.exists():
            break
        missing.append(parent)
    return missing
