"""`ladarreg info FILE`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..arguments import ScanArguments
from ..exit_codes import ExitCode
from ..json_output import print_json
from ..messages import one_line

EXAMPLES = (
    "ladarreg info room.e57",
    "ladarreg info results/registration.json",
    "# a folder of scans and photos, and what register would do with it:",
    "ladarreg info site",
    "# the images that a scanner took, with their cameras and poses:",
    "ladarreg info room.e57 --scan 1 --extract images",
)
_DOCUMENTS = ("registration.json", "comparison.json", "export.json", "panorama.json", "stations.json", "rig.json")


@dataclass(frozen=True, kw_only=True)
class Arguments(ScanArguments):
    """Arguments of `info`."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """A scan, photo, camera, pose, matches or results file, a folder of results or of a run, or one of scans and
    photos."""
    extract: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Extract the images of an E57 file to this folder, with their cameras, and their poses relative to the
    scan (--scan) for --initial."""
    trust_edited: bool = False
    """Describe results, too, that were changed after they were written: given, not verified."""
    json: bool = False
    """Print the description as one JSON document, and nothing else, on stdout; errors, too."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Print a description of the file, one property a line, and extract its images on request."""
    from ladarreg_core.formats import describe, extract_images
    from ladarreg_core.formats.isolated.forked import read_confined

    file = arguments.file
    if file.is_dir() and (document := next(filter(Path.is_file, (file / name for name in _DOCUMENTS)), None)):
        file = document
    elif (file / "run.jsonl").is_file():
        from ladarreg_core.acquisition.composition.panorama import describe_run

        return _print(describe_run(file), as_json=arguments.json)
    elif file.is_dir():
        return _print(_of_folder(file), as_json=arguments.json)
    info = read_confined(describe, file, trust_edited=arguments.trust_edited, **arguments.scan_options)
    facts = list(_facts(info))
    extracted: list[str] = []
    if arguments.extract is not None:
        found = extract_images(arguments.file, arguments.extract, scan_index=arguments.scan_index)
        facts += [("left out", one_line(reason)) for reason in found.damaged]
        for image in found:
            written = (image.picture, image.camera, image.pose)
            extracted += [str(path) for path in written if path is not None]
            facts.append(("extracted", ", ".join(one_line(str(path)) for path in written if path is not None)))
    if arguments.json:
        print_json({**asdict(info), "extracted": extracted})
        return ExitCode.ACCEPTED
    _print_facts(facts)
    return ExitCode.ACCEPTED


def _of_folder(folder: Path) -> Mapping[str, Any]:
    """Return what a folder contains: the results of many photos, or scans and photos."""
    from ladarreg_core.batches.jobs.run_folder import JOBS_RUN, describe_batch
    from ladarreg_core.batches.photos.folder import is_batch_folder
    from ladarreg_core.batches.photos.folder_info import describe_folder
    from ladarreg_core.batches.photos.photo_summary import describe_photos
    from ladarreg_core.formats.isolated.forked import confined_reads

    if is_batch_folder(folder, JOBS_RUN):
        return describe_batch(folder)
    if is_batch_folder(folder):
        return describe_photos(folder)
    with confined_reads():
        return describe_folder(folder)


def _print(info: Mapping[str, Any], *, as_json: bool) -> ExitCode:
    if as_json:
        print_json(info)
    else:
        _print_facts(list(_facts(info)))
    return ExitCode.ACCEPTED


def _print_facts(facts: list[tuple[str, str]]) -> None:
    width = max(len(name) for name, _ in facts)
    for name, value in facts:
        print(f"{name:<{width}}  {value}")


def _facts(info: Any) -> Iterator[tuple[str, str]]:
    pairs = (
        info.items()
        if isinstance(info, Mapping)
        else ((field.name, getattr(info, field.name)) for field in fields(info))
    )
    for name, value in pairs:
        label = str(name).replace("_", " ")
        if value is None or value == () or value == [] or value == {}:
            continue
        if isinstance(value, Mapping) or is_dataclass(value):
            yield from ((f"{label} {inner}", text) for inner, text in _facts(value))
        elif isinstance(value, list | tuple) and value and not all(isinstance(item, int | float) for item in value):
            for number, item in enumerate(value):
                if isinstance(item, Mapping) or is_dataclass(item):
                    yield f"{label} {number}", ", ".join(f"{inner} {text}" for inner, text in _facts(item))
                else:
                    yield label, _text(item)
        else:
            yield label, _text(value)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return " ".join(map(_text, value))
    return one_line(str(value))
