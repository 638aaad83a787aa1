"""`ladarreg register SCAN PHOTO PHOTO ...`, or a folder: many photographs on one scan."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, TypeAlias

import tyro

from .arguments import CameraArguments, OptionalFloat, OptionalInt, OptionalPath, register_options
from .exit_codes import ExitCode
from .messages import one_line
from .progress_bar import progress_bar

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from ladarreg_core.batches.photos.photo_summary import PhotosResult

EXAMPLES = (
    "ladarreg register room.e57 1.jpg 2.jpg 3.jpg -o results",
    "# all photos of a folder:",
    "ladarreg register room.e57 photos -o results",
    "# a folder with the scan and the photos; what would be done:",
    "ladarreg info site",
    "ladarreg register site -o results",
)
_Paths: TypeAlias = list[Path]


@dataclass(frozen=True, kw_only=True)
class PhotosArguments(CameraArguments):
    """Arguments of `register` with several photos."""

    GROUP: ClassVar[tuple[int, str]] = (0, "options")
    files: Annotated[tyro.conf.Positional[_Paths], tyro.conf.arg(metavar="SCAN PHOTO ...")]
    """The scan and the photos in any order; folders of photos; or one folder with both. Further scans are accumulated
    with the first one."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; that of an interrupted run is resumed, any other existing one is refused, but see --force."""
    frame: Literal["scanner", "world"] = "scanner"
    """Coordinates of model.glb and cloud.ply; world: those of the survey, less the offset stated in offset.json."""
    intrinsics: Literal["auto", "fixed", "focal", "focal-k1"] | None = None
    """Camera parameters to estimate; auto: those that the images support, pooled over the photos of one camera."""
    focal_sigma_percent: Annotated[OptionalFloat, tyro.conf.arg(metavar="PERCENT")] = None
    """Without a camera file: standard deviation of the focal length, % (3); 0: exact."""
    centre_sigma_percent: Annotated[OptionalFloat, tyro.conf.arg(metavar="PERCENT")] = None
    """Without a camera file: standard deviation of the principal point, % of the photo's width (1.5); 0: exact."""
    k1_sigma: Annotated[OptionalFloat, tyro.conf.arg(metavar="K1")] = None
    """Without a camera file: standard deviation of the distortion coefficient k1 (.05); 0: exact."""
    processes: Annotated[OptionalInt, tyro.conf.arg(metavar="N")] = None
    """Number of photos that are registered at a time; default: one for each processor core."""
    cache: Annotated[OptionalPath, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder that keeps the scan, and what was made of it, for further runs; default: the user's cache, up to 4 GB."""
    seed: int = 0
    """Random seed; equal seeds give equal results."""
    force: bool = False
    """Replace what OUT contains of other inputs or options, or OUT if it contains results and nothing else."""
    quiet: bool = False
    """Print no progress, and the verdict in one line."""
    json: bool = False
    """Print adjustment.json, and nothing else, on stdout; errors, too."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def is_about_several(words: Sequence[str], flags: Sequence[str]) -> bool:
    """Return whether the words of a command name a folder, or several photos.

    Args:
        words: the words.
        flags: the options that have no value.
    """
    files = [Path(word) for word in _positional(words, flags)]
    if any(file.is_dir() for file in files):
        return True
    if len(files) == 1 and not files[0].exists():  # meant as a folder: a scan alone is not enough
        return True
    if len(files) < 3:
        return False
    from ladarreg_core.formats import listed_kind

    return sum(file.is_file() and listed_kind(file) == "photo" for file in files) > 1


def flags_of(kind: type) -> list[str]:
    """Return the options of a command that have no value."""
    return [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(kind) if field.default is False]


def run_photos(arguments: PhotosArguments) -> ExitCode:
    """Register the photos, write their results and the summary, and print the verdicts."""
    from ladarreg_core.batches.photos.cache import ContentCache
    from ladarreg_core.batches.photos.photo_run import register_photos
    from ladarreg_core.storage.manifest import visible_files

    started = time.perf_counter()
    scans, photos = _scans_and_photos(arguments.files)
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        result = register_photos(
            scans[0],
            photos,
            arguments.out,
            scan_options={**arguments.scan_options, "more": tuple(scans[1:])},
            photo_options=arguments.photo_options,
            options=register_options(arguments),
            frame=arguments.frame,
            processes=arguments.processes,
            cache=ContentCache.of_user() if arguments.cache is None else ContentCache(arguments.cache),
            force=arguments.force,
            report=bar.work,
        )
    files = [name for name in visible_files(arguments.out) if not name.startswith(".")]
    if arguments.json:
        from .json_output import print_json

        print_json({**result.document, "output": {"folder": os.path.abspath(arguments.out), "files": files}})
    elif arguments.quiet:
        print(_verdict(result))
    else:
        print("\n".join(_lines(result)))
        print(f"Wrote    {', '.join(files)} in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED if result.accepted else ExitCode.NOT_ACCEPTED


def _positional(words: Sequence[str], flags: Sequence[str]) -> list[str]:
    """Return the words that are neither options nor values of options."""
    found, is_value = [], False
    for word in words:
        if is_value:
            is_value = False
        elif word.startswith("-"):
            is_value = "=" not in word and word not in flags
        else:
            found.append(word)
    return found


def _scans_and_photos(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the scans and the photos of files and folders.

    Raises:
        OptionError: if there is no scan or no photo, or a folder with several scans.
    """
    from ladarreg_core.batches.photos.photo_list import folder_contents
    from ladarreg_core.errors import OptionError
    from ladarreg_core.formats.registry import recognise

    scans: list[Path] = []
    photos: list[Path] = []
    for file in (file for file in files if not file.is_dir()):
        kind = recognise(file, kinds=("photo", "scan")).kind
        (photos if kind == "photo" else scans).append(file)
    for folder in (file for file in files if file.is_dir()):
        contents = folder_contents(folder)
        photos += contents.photos
        if not any(not file.is_dir() for file in files):
            scans += contents.scans
            if len(scans) > 1:
                names = ", ".join(scan.name for scan in scans)
                raise OptionError(f"{folder} contains {len(scans)} scans ({names}); name the one that is meant")
    if not scans:
        raise OptionError("there is no scan among the files; give one scan and the photos, or a folder with both")
    if not photos:
        raise OptionError("there is no photo among the files; give one scan and the photos, or a folder with both")
    return scans, photos


def _verdict(result: PhotosResult) -> str:
    accepted = sum(one["accepted"] for one in result.photos.values())
    return f"{accepted} of {len(result.photos)} photos were accepted."


def _lines(result: PhotosResult) -> list[str]:
    """Return the verdict, the cameras, and a line for each photo, failures first."""
    lines = [_verdict(result)]
    for camera in result.cameras.values():
        if camera["pooled"]:
            focal, sigma = camera["camera"]["fx"], camera["sigmas"]["focal_px"]
            lines.append(
                f"Camera   {one_line(camera['is'])}: {focal:.1f} +- {sigma:.1f} px, pooled over "
                f"{len(camera['pooled'])} of {len(camera['photos'])} photos"
            )
    notes = dict.fromkeys(note for scan in result.document["scans"].values() for note in scan["notes"])
    lines += [f"Note     {one_line(note)}" for note in notes]
    for one in sorted(result.photos.values(), key=lambda one: bool(one["accepted"])):
        lines.append(f"Photo    {one_line(one['input']['name'])}: {_photo_words(one)}")
    return lines


def _photo_words(photo: Mapping[str, Any]) -> str:
    if not photo["accepted"]:
        return one_line(" ".join([photo["verdict"], *photo["reasons"][:1]]))
    sigma_mm = 1000 * photo["sigma"]["position_m"]
    return f"{one_line(photo['verdict'])} Sigma {sigma_mm:.1f} mm"
