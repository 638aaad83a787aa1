"""`ladarreg register SCAN PHOTO [SCAN ...] -o OUT`, and its variants for a rig and for many photos."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..arguments import OptionalPath, RegisterArguments, check_method, register_options
from ..exit_codes import ExitCode
from ..inputs import print_notes, read_inputs, read_start, spare_heap, timed, with_photo_named, with_recorded_options
from ..json_output import print_written
from ..messages import assessment_lines, length_lines, report, verdict
from ..open_command import open_command
from ..progress_bar import ProgressBar, progress_bar

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.quality.smoothing import SmoothedScan
    from ladarreg_core.results.registration import Registration
    from ladarreg_core.scan import Scan

    from ..photos import PhotosArguments
    from ..rig import RigArguments

EXAMPLES = (
    "ladarreg register room.e57 photo.jpg -o results",
    "# with a calibrated camera, in the survey's coordinates:",
    "ladarreg register room.e57 photo.jpg --camera cam.json --frame world -o out",
    "# several clouds of a scanner at rest, accumulated:",
    "ladarreg register 1.pcd 2.pcd 3.pcd photo.png --camera cam.json -o out",
    "# pairs of a scanner and a camera that are mounted together:",
    "ladarreg register --rig pairs.csv --camera cam.json -o rig",
    "ladarreg register --rig run.mcap --cloud /points --image /image -o rig",
    "# several photos, or a folder of them: one camera, one summary:",
    "ladarreg register room.e57 1.jpg 2.jpg 3.jpg -o results",
    "# from matches drawn by hand:",
    "ladarreg register room.e57 photo.jpg --matches matches.json -o results",
    "# the pose of these matches as they are, not refined against the image:",
    "ladarreg register room.e57 photo.jpg --matches m.json --proposal drawn -o out",
)


@dataclass(frozen=True, kw_only=True)
class Arguments(RegisterArguments):
    """Arguments of `register`."""

    method: Literal["auto", "thesis", "manual"] = "auto"
    """Registration method. With --matches, auto means manual, and thesis solves these matches."""
    proposal: Literal["refined", "drawn", "images"] | None = None
    """Pose to propose of --matches: refined, as the images verify it, unless they contradict the matches (default);
    drawn; or images, theirs in any case."""
    smooth: bool = False
    """Replace range spikes at matches by their stereo range in model.glb and cloud.ply."""
    frame: Literal["scanner", "world"] = "scanner"
    """Coordinates of model.glb and cloud.ply; world: those of the survey, less the offset stated in offset.json."""
    carry: Annotated[OptionalPath, tyro.conf.arg(metavar="FILE")] = None
    """Carry the pose over from this registration.json of another camera on the same mount; needs --offset."""
    offset: Annotated[OptionalPath, tyro.conf.arg(metavar="FILE")] = None
    """Pose JSON of this camera relative to the other one; may contain sigma_angle_rad and sigma_position_m."""

    rig: Annotated[OptionalPath, tyro.conf.arg(metavar="FILE")] = None
    """Instead of SCAN and PHOTO: a table of pairs that one scanner and camera took from several places, or a recording
    with clouds and pictures."""

    @classmethod
    def chosen_by(cls, words: Sequence[str]) -> type:
        """Return the arguments that words are of: those of a rig, of several photos, or of one pair."""
        if any(word.split("=")[0] == "--rig" for word in words):
            from ..rig import RigArguments

            return RigArguments
        from ..photos import PhotosArguments, flags_of, is_about_several

        return PhotosArguments if is_about_several(words, flags_of(cls)) else cls


def run(arguments: Arguments | RigArguments | PhotosArguments) -> ExitCode:
    """Read, register, export, and print the verdict."""
    if not isinstance(arguments, Arguments):
        from ..photos import PhotosArguments, run_photos
        from ..rig import run_rig

        return run_photos(arguments) if isinstance(arguments, PhotosArguments) else run_rig(arguments)
    import ladarreg_core as lr
    from ladarreg_core.camera import require_pinhole
    from ladarreg_core.export.output_frame import OutputFrame
    from ladarreg_core.export.targets.folder import check_folder, prepare_export
    from ladarreg_core.foundations.parallel import OtherCore
    from ladarreg_core.quality.assessment import assess

    started = time.perf_counter()
    arguments = with_photo_named(arguments)
    check_folder(arguments.out, force=arguments.force, inputs=_input_files(arguments))
    arguments = with_recorded_options(arguments, arguments.initial, arguments.carry)
    check_method(arguments, arguments.method)
    _check_carry(arguments)
    with progress_bar(quiet=arguments.quiet) as bar:
        scan, photo = read_inputs(arguments, bar, arguments.initial, arguments.carry, soon=lambda: lr.register)
        if arguments.smooth:
            require_pinhole(photo.camera, "--smooth")  # before the work that would be lost
        OutputFrame.of(scan, arguments.frame)  # refuse before the work
        with OtherCore() as other_core:
            other_core.begin(lambda: prepare_export(scan))
            picks, initial = (None, None) if arguments.carry else read_start(arguments, scan)
            result = _register(arguments, scan, photo, bar, picks, initial)
        spare_heap(scan)
        assessment = timed("Assess", bar, lambda: assess(scan, result))
        smoothed = _smooth(arguments, result, scan, picks or (), bar)
        names = _export(arguments, result, scan, photo, bar, assessment=assessment, smoothed=smoothed)
    if arguments.json:
        print_written(arguments.out, "registration.json", scan, photo)
    elif arguments.quiet:
        print(verdict(result))
    else:
        print_notes(scan, photo)
        print("\n".join([report(result), *length_lines(result), *assessment_lines(assessment, result)]))
        if arguments.smooth:
            print(
                f"Smooth   {smoothed.sentence if smoothed else 'Skipped: only an accepted registration is smoothed.'}"
            )
        print(f"Wrote    {', '.join(names)} in {arguments.out}")
        if not result.accepted:
            print(f"Open     {open_command(arguments)}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED if result.accepted else ExitCode.NOT_ACCEPTED


def _input_files(arguments: Arguments) -> list[Path]:
    return [*arguments.input_files, *(path for path in (arguments.carry, arguments.offset) if path)]


def _check_carry(arguments: Arguments) -> None:
    """Refuse incomplete or ignored arguments of --carry."""
    from ladarreg_core.errors import OptionError

    if (arguments.carry is None) != (arguments.offset is None):
        raise OptionError("--carry and --offset go together; give both or neither")
    if arguments.carry and (arguments.matches or arguments.initial or arguments.method != "auto"):
        raise OptionError("--carry does not solve for a pose; omit --matches, --initial and --method")


def _register(
    arguments: Arguments, scan: Scan, photo: Photo, bar: ProgressBar, picks: list[Pick] | None, initial: Rigid | None
) -> Registration:
    import ladarreg_core as lr

    if arguments.carry and arguments.offset:
        from ladarreg_core.formats.documents.registration_file import read_offset, read_registration
        from ladarreg_core.registration.carry import carry_over

        first = read_registration(
            arguments.carry, option="register that photo again, or give the file as it was written"
        )
        offset = read_offset(arguments.offset)
        carried = timed("Carry over", bar, lambda: carry_over(first, offset, photo))
        return replace(carried, world_from_scanner=scan.world_from_scanner)  # it stands in this scan's world
    return lr.register(
        scan,
        photo,
        method=arguments.method,
        picks=picks,
        initial=initial,
        options=register_options(arguments),
        report=bar.step,
    )


def _smooth(
    arguments: Arguments, result: Registration, scan: Scan, picks: Sequence[Pick], bar: ProgressBar
) -> SmoothedScan | None:
    if not arguments.smooth or not result.accepted:
        return None
    from ladarreg_core.quality.smoothing import smooth_with_report

    return timed("Smooth", bar, lambda: smooth_with_report(scan, result, picks=picks))


def _export(
    arguments: Arguments,
    result: Registration,
    scan: Scan,
    photo: Photo,
    bar: ProgressBar,
    *,
    assessment: Assessment,
    smoothed: SmoothedScan | None,
) -> list[str]:
    from ladarreg_core.export.targets.folder import export_registration
    from ladarreg_core.storage.manifest import visible_files

    export_registration(
        arguments.out,
        result,
        scan,
        photo,
        assessment=assessment,
        smoothed=smoothed,
        inputs=_input_files(arguments),
        read_with=arguments.read_with,
        frame=arguments.frame,
        open_command=None if result.accepted else open_command(arguments),
        force=arguments.force,
        report=bar.progress,
    )
    return visible_files(arguments.out)
