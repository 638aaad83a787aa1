"""`ladarreg model RESULT... -o OUT`."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import tyro

from ..arguments import ScanArguments
from ..exit_codes import ExitCode
from ..inputs import suit_heap, timed
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.export.outputs.model_folder import PhotoValues
    from ladarreg_core.export.outputs.model_sources import ModelSources

EXAMPLES = (
    "# of many photos on one scan, or of an adjusted survey:",
    "ladarreg model results -o model",
    "ladarreg model results-1 results-2 --to glb -o model --root data",
    "# counts of a gamma camera for the pixels of a photo, as a layer:",
    "ladarreg model results --values gamma:counts/s:IMG_0003:counts.tif -o model",
)
_Paths: TypeAlias = list[Path]
_Names: TypeAlias = list[str]
_PARTS_OF_VALUES = 4


@dataclass(frozen=True, kw_only=True)
class Arguments(ScanArguments):
    """Arguments of `model`."""

    results: Annotated[tyro.conf.Positional[_Paths], tyro.conf.arg(metavar="RESULT")]
    """Folders of results, a folder of many photos, or of an adjusted survey with several scans."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    to: Annotated[str, tyro.conf.arg(metavar="FORMATS")] = "glb,laz,ply"
    """Files beside the pictures of the layers, separated by commas: glb, laz, ply, e57, potree, tiles."""
    values: Annotated[tyro.conf.UseAppendAction[_Names], tyro.conf.arg(metavar="QUANTITY")] = field(
        default_factory=list
    )
    """Values of a sensor as a layer, NAME:UNIT:PHOTO or NAME:UNIT:PHOTO:FILE: the pixels of that photo are no colours
    but values, or FILE is an image of values with the same field of view. Thermal photos need none. Repeatable."""
    vignetting: bool = False
    """Estimate the vignetting of each lens from overlaps of its photos, and correct it."""
    scan_index: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Index of the scan in a file with several, for results that do not record it."""
    root: Annotated[tyro.conf.UseAppendAction[_Paths], tyro.conf.arg(metavar="FOLDER")] = field(default_factory=list)
    """Folder where the scans and the photos are looked for, too. Repeatable."""
    frame: Literal["scanner", "world"] = "scanner"
    """Coordinates of cloud and model; with several scans those of the world, less a stated offset."""
    trust_edited: bool = False
    """Go on with results that were changed after they were written; their photos count as given, and are left out."""
    temperature_unit: Literal["K", "C", "none"] | None = None
    """Unit of the pixels of a thermal photo, for results that do not record it."""
    force: bool = False
    """Replace OUT if it contains an earlier model and nothing else; any other folder is never touched."""
    quiet: bool = False
    """Print nothing but what was left out."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Fuse the accepted photos and write the model."""
    from ladarreg_core.export.outputs.model_folder import check_formats, write_model
    from ladarreg_core.export.outputs.model_sources import read_model_sources
    from ladarreg_core.export.targets.folder import check_folder

    started = time.perf_counter()
    formats = [name.strip() for name in arguments.to.split(",") if name.strip()]
    check_formats(formats)
    check_folder(arguments.out, force=arguments.force, inputs=arguments.results)
    with progress_bar(quiet=arguments.quiet) as bar:
        sources: ModelSources = timed(
            "Read inputs",
            bar,
            lambda: read_model_sources(
                arguments.results,
                folders=arguments.root,
                scan_options=arguments.scan_options,
                temperature_unit=arguments.temperature_unit,
                trust_edited=arguments.trust_edited,
                frame=arguments.frame,
                option="--root",
                report=bar.loading,
            ),
        )
        for handed in sources.scans:
            suit_heap(handed.scan)
        values = _values(arguments.values, sources)
        written = write_model(
            arguments.out, sources, formats=formats, values=values, vignetting=arguments.vignetting,
            force=arguments.force, report=bar.progress,
        )  # fmt: skip
    for name, why in sources.left_out:
        print(f"Left out {name}: {why}")
    if not arguments.quiet:
        for one in written.document["photos"]:
            share = f"colours {100 * one['share']:.1f} % of the surface" if one["colors"] else "a layer"
            moved = f", {100 * one['moved']:.1f} % of it moved" if one["moved"] > 0 else ""
            corners = (
                "" if one["vignetting"] is None else f", corners at {100 * math.exp(sum(one['vignetting'])):.0f} %"
            )
            print(f"Photo    {one['id']}: {share}{moved}{corners}")
        for scan in written.document["scans"]:
            print(f"Scan     {scan['name']}: {scan['returns']} returns, {scan['cut']} cut")
        print(f"Layers   {', '.join(one.name for one in written.layers if one.values is not None)}")
        print(f"Frame    {written.document['frame_is']}")
        print(f"Wrote    {', '.join(written.document['files'][:4])} and more in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED


def _values(given: Sequence[str], sources: ModelSources) -> list[PhotoValues]:
    """Return the values of sensors as given on the command line.

    Raises:
        OptionError: if one is not of the form NAME:UNIT:PHOTO or NAME:UNIT:PHOTO:FILE, or its file is not found.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.outputs.model_folder import PhotoValues
    from ladarreg_core.formats.photos.values_file import read_values
    from ladarreg_core.fusion.layers import Quantity

    found = []
    for text in given:
        name, unit, photo, *rest = [part.strip() for part in text.split(":", _PARTS_OF_VALUES - 1)] + [""] * 3
        if not photo:
            raise OptionError(
                f"--values {text!r:.80} is not NAME:UNIT:PHOTO or NAME:UNIT:PHOTO:FILE; give for example "
                "gamma:counts/s:IMG_0003"
            )
        photos = [one for handed in sources.scans for one in handed.photos]
        own = next((one.file for one in photos if one.file is not None and photo in (one.id, one.file.name)), None)
        file = Path(rest[0]) if rest[0] else own
        if file is None or not file.is_file():
            what = f"{file}: file not found" if file is not None else f"there is no photo {photo!r:.60}"
            raise OptionError(f"{what}; --values names a photo of the model ({', '.join(one.id for one in photos)})")
        found.append(PhotoValues(photo, Quantity(name, unit), read_values(file), not rest[0], file))
    return found
