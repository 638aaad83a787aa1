"""Command-line arguments: parsing by tyro, and the arguments that the registering commands share."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Optional, TypeAlias, TypeVar, Union

import tyro

if TYPE_CHECKING:
    from ladarreg_core.registration.register import RegisterOptions

# tyro checks a default of None against `X | None` by typeguard, which imports asyncio and a mock library and
# takes as long as all else of the parsing; against `Optional[X]` it does without.
OptionalPath: TypeAlias = Optional[Path]  # noqa: UP045
OptionalStr: TypeAlias = Optional[str]  # noqa: UP045
OptionalFloat: TypeAlias = Optional[float]  # noqa: UP045
OptionalInt: TypeAlias = Optional[int]  # noqa: UP045
OptionalPaths: TypeAlias = Union[None, tuple[Path, ...]]  # noqa: UP007, RUF036 (None is tried first)

T = TypeVar("T")
_ARGUMENT = re.compile(r"((?:-[a-z] [A-Z]+, )?--[a-z-]+|[A-Z]{3,})(?= |$)")
_FRAME = re.compile(r"^[\s│|╭╰╮╯─┌└┐┘+]*(?:-{3,})?|[\s│|╮╯─+]*$")
_INVALID_CHOICE = re.compile(r"invalid choice '([^']*)' for argument '([^']*)'.*?\((.*)\)")
_TOO_MANY = "Unrecognized options:"


def parse(kind: type[T], words: Sequence[str], *, prog: str, description: str) -> T:
    """Parse words into a frozen `Arguments`, or into those of a variant that its `chosen_by` chooses by the words.

    Raises:
        OptionError: naming what is missing, misspelt or invalid.
        SystemExit: 0 after help.
    """
    from ladarreg_core.errors import OptionError

    from .help import examples_of, help_text, misspelt

    plain: type = kind
    kind = getattr(kind, "chosen_by", lambda _: kind)(words)
    if "-h" in words or "--help" in words:
        print(help_text(kind, prog=prog, summary=description, examples=examples_of(kind)))
        raise SystemExit(0)
    wrong = misspelt(kind, words, plain=plain)
    if wrong is not None:
        raise OptionError(f"{wrong} (see {prog} --help)")
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(
                kind, args=list(words), prog=prog, description=description, config=(tyro.conf.FlagCreatePairsOff,)
            )
    except SystemExit:
        raise OptionError(f"{_in_words(condense(errors.getvalue()), kind)}; see {prog} --help") from None


def _in_words(text: str, kind: type) -> str:
    """Return an error of the parser on a choice or a word too many in plainer words; any other text unchanged."""
    from .help import arguments_of, suggestion

    if text.startswith(_TOO_MANY):
        return f"more words than the command takes:{text.removeprefix(_TOO_MANY)}"
    found = _INVALID_CHOICE.search(text)
    if found is None:
        return text
    value, name, listed = found.groups()
    names = {name: one.choices for one in arguments_of(kind, with_texts=False) for name in (one.name, *one.flags)}
    choices = names.get(name.lower()) or [one for one in re.findall(r"'([^']*)'", listed) if one != "None"]
    near, use = suggestion(value, choices), f"; use one of {', '.join(choices)}"
    return f"{value!r} is not a choice of {name}{near or use}".rstrip("?")


def condense(box: str) -> str:
    """Return the first paragraph of a boxed error message as one line."""
    title, *lines = (_FRAME.sub("", line) for line in box.splitlines())
    if "Required" in title or any(line.startswith("Missing from") for line in lines):
        names = [match.group(1) for line in lines if (match := _ARGUMENT.match(line))]
        return f"missing {', '.join(dict.fromkeys(names))}"
    paragraph: list[str] = []
    for line in lines:
        if not line and paragraph:
            break
        if line:
            paragraph.append(line)
    return " ".join(paragraph).rstrip(".:") or "the arguments could not be parsed"


@dataclass(frozen=True, kw_only=True)
class ScanArguments:
    """What the file of a scan does not say itself."""

    GROUP: ClassVar[tuple[int, str]] = (30, "scan: what its file does not say itself")
    scan_index: Annotated[int, tyro.conf.arg(aliases=["--scan"], metavar="N")] = 0
    """Index of the scan in a file with several, from 0; `ladarreg info FILE` lists them."""
    origin: Annotated[OptionalStr, tyro.conf.arg(metavar="X,Y,Z")] = None
    """Where the scanner stood, in the coordinates of the file, m; for clouds that are not in the scanner's frame."""
    intensity: Literal["auto", "luma"] = "auto"
    """Source of the intensity; luma: the luminance of the points' colours."""
    columns: Annotated[OptionalStr, tyro.conf.arg(metavar="NAMES")] = None
    """Columns of a text file without a header, e.g. x,y,z,intensity; - skips one."""
    topic: Annotated[OptionalStr, tyro.conf.arg(metavar="NAME")] = None
    """Topic of the clouds in a recording."""
    seconds: Annotated[OptionalFloat, tyro.conf.arg(metavar="S")] = None
    """Duration over which the clouds of a recording are accumulated."""

    @property
    def scan_options(self) -> dict[str, Any]:
        """The arguments of `read_scan`.

        Raises:
            OptionError: if one is not of its type or range.
        """
        from ladarreg_core.formats.scans.scan_request import SCAN_OPTIONS, ScanOptions

        stated = {name: getattr(self, name) for name in SCAN_OPTIONS}
        if self.origin is not None:
            stated["origin"] = _coordinates(self.origin)
        stated["columns"] = tuple(name.strip() for name in self.columns.split(",")) if self.columns else ()
        return ScanOptions(**stated).as_arguments()


@dataclass(frozen=True, kw_only=True)
class PhotoCameraArguments:
    """What is known of a photo and its camera."""

    GROUP: ClassVar[tuple[int, str]] = (20, "photo and camera")
    camera: Annotated[OptionalPath, tyro.conf.arg(metavar="FILE")] = None
    """Camera of the photo: JSON, OpenCV, ROS, Kalibr, COLMAP, nerfstudio or Agisoft."""
    camera_name: Annotated[OptionalStr, tyro.conf.arg(metavar="NAME")] = None
    """Camera of a file with several; default: chosen by the photo's name and size."""
    focal_px: Annotated[OptionalFloat, tyro.conf.arg(metavar="PX")] = None
    """Focal length of the photo in pixels, if there is no camera file."""
    focal_mm: Annotated[OptionalFloat, tyro.conf.arg(metavar="MM")] = None
    """Focal length of the photo in mm; needs --sensor-mm; default: that of EXIF."""
    sensor_mm: Annotated[OptionalFloat, tyro.conf.arg(metavar="MM")] = None
    """Sensor width (longer side) in mm."""
    camera_model: Literal["pinhole", "equirectangular"] | None = None
    """Model of the photo's camera without a camera file: equirectangular is a panorama; default: as its XMP says."""
    temperature_unit: Literal["K", "C", "none"] | None = None
    """Unit of the pixels of a thermal TIFF that does not state it; none: the pixels are no temperatures."""

    @property
    def photo_options(self) -> dict[str, Any]:
        """The arguments of `read_photo`."""
        return {name: getattr(self, name) for name in PhotoCameraArguments.__annotations__ if name != "GROUP"}


@dataclass(frozen=True, kw_only=True)
class CameraArguments(PhotoCameraArguments, ScanArguments):
    """What is known of a photo, its camera, and a scan."""


@dataclass(frozen=True, kw_only=True)
class PhotoArguments(CameraArguments):
    """Scan, photo, and what is known about them; output folder."""

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """Scan: E57, PTX, LAS, LAZ, PLY, PTS, XYZ, CSV, PCD, bag, MCAP, PCAP, NPZ ..."""
    photo: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTO")]
    """Photo: JPEG, PNG, TIFF, WebP, AVIF."""
    more: Annotated[tyro.conf.Positional[OptionalPaths], tyro.conf.arg(metavar="[SCAN ...]")] = None
    """Further scans of the same standpoint, to be accumulated; the photo may stand anywhere among the files."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    seed: int = 0
    """Random seed; equal seeds give equal results."""
    force: bool = False
    """Replace OUT if it contains results of an earlier run and nothing else; any other folder is never touched."""
    quiet: bool = False
    """Print no progress, and the verdict in one line."""
    json: bool = False
    """Print the result as one JSON document, and nothing else, on stdout; errors, too."""
    debug: bool = False
    """Print a log, and a traceback on failure."""

    @property
    def scan_options(self) -> dict[str, Any]:
        """The arguments of `read_scan`.

        Raises:
            OptionError: if the origin is not three numbers.
        """
        return {**ScanArguments.scan_options.__get__(self), "more": self.more or ()}

    @property
    def input_files(self) -> list[Path]:
        """Every file that was given."""
        return [path for path in (self.scan, self.photo, self.camera, *(self.more or ())) if path is not None]

    @property
    def read_with(self) -> list[dict[str, Any]]:
        """The options that the scan and the photo are read with, recorded with the results."""
        return [self.scan_options, self.photo_options]


@dataclass(frozen=True, kw_only=True)
class InputArguments(PhotoArguments):
    """The inputs, and where to start from."""

    GROUP: ClassVar[tuple[int, str]] = (10, "matches and initial pose")
    matches: Annotated[OptionalPath, tyro.conf.arg(metavar="FILE")] = None
    """Manual matches: JSON, or CSV of points; rays, cells, or points with their lengths."""
    initial: Annotated[OptionalPath, tyro.conf.arg(metavar="FILE")] = None
    """Initial pose: a pose JSON (scanner or world), an earlier registration.json, or transforms.json. A
    registration.json of the same files also says with which options and further scans they are read."""

    @property
    def input_files(self) -> list[Path]:
        """Every file that was given."""
        own = PhotoArguments.input_files.__get__(self)
        return [*own, *(path for path in (self.matches, self.initial) if path is not None)]


@dataclass(frozen=True, kw_only=True)
class EstimationArguments(InputArguments):
    """What is estimated, and with which tolerances; an omitted flag leaves the default."""

    GROUP: ClassVar[tuple[int, str]] = (40, "estimation")
    intrinsics: Literal["auto", "fixed", "focal", "focal-k1", "focal-k1-centre"] | None = None
    """Camera parameters to estimate; auto: those that the image, or held-out matches, support."""
    focal_sigma_percent: Annotated[OptionalFloat, tyro.conf.arg(metavar="PERCENT")] = None
    """Without a camera file: standard deviation of the focal length, % (3); 0: exact."""
    centre_sigma_percent: Annotated[OptionalFloat, tyro.conf.arg(metavar="PERCENT")] = None
    """Without a camera file: standard deviation of the principal point, % of the photo's width (1.5); 0: exact."""
    k1_sigma: Annotated[OptionalFloat, tyro.conf.arg(metavar="K1")] = None
    """Without a camera file: standard deviation of the distortion coefficient k1 (.05); 0: exact."""
    match_tolerance_m: Annotated[OptionalFloat, tyro.conf.arg(metavar="M")] = None
    """Largest difference allowed between lengths of matches and the scan's ranges; default: 3 sigma, at least .05."""


@dataclass(frozen=True, kw_only=True)
class RegisterArguments(EstimationArguments):
    """The inputs, and the thresholds of the thesis; an omitted flag leaves the default."""

    GROUP: ClassVar[tuple[int, str]] = (50, "the thesis's method")
    t1: Annotated[OptionalFloat, tyro.conf.arg(metavar="C")] = None
    """Minimum lead of the best correlation over the second best (.2)."""
    t2_px: Annotated[OptionalFloat, tyro.conf.arg(metavar="PX")] = None
    """Maximum deviation of a disparity from the median (20)."""
    culling: Literal["two-sided", "one-sided"] | None = None
    """Filter disparities on both sides, or on one as in its Step 5."""
    first_pose: Literal["linear", "robust", "linear-only"] | None = None
    """The pose that predicts positions for guided matching."""
    residual: Literal["epipolar", "stereo"] | None = None
    """The residual that the simplex minimises; stereo is Eq 2.21."""
    reject_depth_m: Annotated[OptionalFloat, tyro.conf.arg(metavar="M")] = None
    """Stereo depth error above which a match is an outlier; default: estimated from the data."""
    samples_per_line: Annotated[OptionalInt, tyro.conf.arg(metavar="N")] = None
    """Sample points per manual line (9)."""


def check_method(arguments: RegisterArguments, method: str) -> None:
    """Refuse thresholds that the chosen method does not use.

    Raises:
        OptionError: naming the flag.
    """
    from ladarreg_core.registration.stated_options import check_stated

    check_stated(vars(arguments), method)


def register_options(arguments: object) -> RegisterOptions:
    """Return the options of a registration, as far as arguments state them."""
    from ladarreg_core.registration.stated_options import options_of

    return options_of(vars(arguments))


def _coordinates(text: str) -> tuple[float, ...]:
    from ladarreg_core.errors import OptionError

    try:
        numbers = tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError:
        numbers = ()
    if len(numbers) != 3:
        raise OptionError(f"--origin is {text[:60]!r}; give three coordinates in metres, e.g. --origin 12.5,-3,1.8")
    return numbers
