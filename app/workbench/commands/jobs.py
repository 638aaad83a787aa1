"""The commands that start jobs and control them."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from msgspec import Meta

from ladarreg_core.errors import OptionError
from ladarreg_core.project import edits

from ...jobs.export import Wanted
from .command import Context, PhotoId, PhotoIds, Reply, WorkbenchCommand
from .matches import PhotoCommand

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.project.document import PhotoEntry

    from ..state.clients import Client

_MAX_ACTION = 80
_MAX_PATH, _MAX_PATH_PART = 4000, 255
TargetNames = Annotated[list[str], Meta(max_length=1000, title="the targets are a list of names")]
_NOTHING = (0.0, 0.0, 0.0)
_Amount = Annotated[float, Meta(ge=-1e4, le=1e4)]
_SHIFT, _TURN = (
    "a shift is three lengths, m: right, down, forward",
    "a turn is three angles, degrees: up, right, clockwise",
)
Shift = Annotated[list[_Amount], Meta(min_length=3, max_length=3, title=_SHIFT)]
Turn = Annotated[list[_Amount], Meta(min_length=3, max_length=3, title=_TURN)]


class Run(WorkbenchCommand, frozen=True):
    """starts a job, and returns its id"""

    replies: ClassVar[str] = "job"
    photo: PhotoId
    job: Annotated[str, Meta(title="give the name of a job")]

    def execute(self, context: Context, client: Client) -> Reply:
        """Start it."""
        return {"job": context.jobs.run(self.job, self.photo, client.author)}


class RegisterAll(WorkbenchCommand, frozen=True):
    """registers photographs one after the other from the images: those of `photos`, ids, or all that are not accepted
    yet (null); each result is kept as it comes
    """

    replies: ClassVar[str] = "job"
    photos: PhotoIds | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Start it."""
        return {"job": context.jobs.register_all(self.photos, client.author)}


class Adjust(RegisterAll, frozen=True):
    """solves photographs (null: all), cameras and scans together, and takes over all poses in one step of the history,
    see [surveys.md](surveys.md)
    """

    def execute(self, context: Context, client: Client) -> Reply:
        """Start it."""
        return {"job": context.jobs.adjust(self.photos, client.author)}


class Refine(WorkbenchCommand, frozen=True):
    """registers from the images, starting from a rough pose: the matrix (4 rows), or where this client looks from in
    the 3-D view
    """

    replies: ClassVar[str] = "job"
    photo: PhotoId
    camera_from_scanner: list[list[float]] | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Start it."""
        given = self.camera_from_scanner
        entry = edits.require_photo(context.session.document, self.photo)
        initial = seen_by(context, client, entry) if given is None else edits.pose(given)
        return {"job": context.jobs.run_refine(self.photo, client.author, initial)}


class PlaceCamera(PhotoCommand, frozen=True):
    """places the photograph's camera by hand, for this client: at a pose, the matrix (4 rows), or at the `start`, where
    the shown pose, the scanner or this client's 3-D view is; then moves it by `shift_m` (right, down, forward) and
    turns it by `turn_deg` (up, right, clockwise); without a pose and a start it ends placing
    """

    replies: ClassVar[str] = "camera_from_scanner"
    camera_from_scanner: list[list[float]] | None = None
    start: Literal["pose", "scanner", "view"] | None = None
    shift_m: Shift | None = None
    turn_deg: Turn | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Place it."""
        from ladarreg_core.inspection.viewpoints import nudged

        before = self._before(context, client)
        placed = None
        if before is not None:
            turn_rad = [radians(each) for each in self.turn_deg or _NOTHING]
            placed = edits.pose(nudged(before, shift_m=self.shift_m or _NOTHING, turn_rad=turn_rad).matrix)
        if context.scene is not None:
            in_view = None if placed is None else placed @ context.queries.place_beside(self.entry(context)).inverse
            context.scene.place_camera(client.id, in_view)
        return {"camera_from_scanner": None if placed is None else placed.matrix.tolist()}

    def _before(self, context: Context, client: Client) -> Rigid | None:
        from ladarreg_core.inspection.figures import pose_at_scanner
        from ladarreg_core.project.results import pose_of

        entry = self.entry(context)
        if self.camera_from_scanner is not None:
            return edits.pose(self.camera_from_scanner)
        if self.start is None:
            return None
        context.loader.photo(entry)  # without a focal length there is no frustum
        if self.start == "pose":
            if entry.pose is None:
                raise OptionError("no pose is shown; start from the scanner or from the 3-D view")
            return pose_of(entry.pose)
        if self.start == "scanner":
            scan = context.loader.scan(context.session.document.beside(entry))
            if scan is None:
                raise OptionError("there is no scan; open one")
            return pose_at_scanner(scan)
        return seen_by(context, client, entry)


def seen_by(context: Context, client: Client, entry: PhotoEntry) -> Rigid:
    """Return the pose of a camera that stands where a client looks from, in the frame of the scan beside a photograph.

    Raises:
        OptionError: without a 3-D view, or where that frame is not known in it.
    """
    seen = None if context.scene is None else context.scene.pose_of(client.id)
    if seen is None:
        raise OptionError("the 3-D view is not open yet; wait until the model is shown")
    return seen @ context.queries.place_beside(entry)


class JobControl(WorkbenchCommand, frozen=True):
    """controls the running job: `pause`, `resume`, `stop`, `step`, or `speed` with its value; stops a waiting `job`"""

    action: Annotated[str, Meta(title="give an action: pause, resume, stop, step or speed")]
    value: float | None = None
    job: str | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Control it."""
        context.runner.control(self.action[:_MAX_ACTION], self.value, job=self.job)
        return {}


class ExportTargets(WorkbenchCommand, frozen=True):
    """what can be exported: all targets `{name, title, purpose, refusal}`, whose `refusal` says why one cannot be
    written (null: it can); `photos` are ids (null: all), the reply's `{id, name}` are exported to `targets` and those
    of `left_out`, `{id, name, why, is_stale}`, are not
    """

    replies: ClassVar[str] = "targets, photos, left_out"
    targets: TargetNames | None = None
    photos: PhotoIds | None = None
    frame: Literal["scanner", "world"] = "scanner"
    full: bool = False
    crop: Literal["none", "photo"] = "none"
    last_solved: bool = False

    @property
    def wanted(self) -> Wanted:
        """What is exported."""
        return Wanted(
            targets=self.targets or (), photos=self.photos, frame=self.frame, full=self.full, crop=self.crop,
            last_solved=self.last_solved,
        )  # fmt: skip

    def execute(self, context: Context, client: Client) -> Reply:
        """Return it."""
        return context.jobs.exports.table(self.wanted)


class Export(ExportTargets, frozen=True):
    """exports photographs and stations to targets by their names, as a zip or, with `folder`, into one of the server's
    machine, where `force` replaces an earlier export (see Exports); `frame` of points, models and poses; `full`: whole
    meshes; `crop: "photo"`: models only where a photograph covers them
    """

    replies: ClassVar[str] = "job"
    folder: Annotated[str, Meta(title="give the folder to export to")] | None = None
    force: bool = False

    def execute(self, context: Context, client: Client) -> Reply:
        """Start it."""
        folder = None if self.folder is None else _folder_path(self.folder)
        export = context.jobs.exports.begin(self.wanted, folder, force=self.force)
        return {"job": context.jobs.run_export(export, client.author)}


class WriteReport(WorkbenchCommand, frozen=True):
    """writes a photograph's report as a page to be opened in a tab"""

    replies: ClassVar[str] = "job"
    photo: PhotoId

    def execute(self, context: Context, client: Client) -> Reply:
        """Start it."""
        return {"job": context.jobs.run_export(context.jobs.exports.begin_page(self.photo), client.author)}


def _folder_path(text: str) -> Path:
    """Return the path of a folder if its name is valid.

    Raises:
        OptionError: if it is empty, too long, or contains control characters.
    """
    name = text.strip()
    if not name:
        raise OptionError("give the folder to export to", field="folder")
    if not name.isprintable():
        raise OptionError("the folder's path contains control characters; enter it again", field="folder")
    if len(name.encode()) > _MAX_PATH or any(len(part.encode()) > _MAX_PATH_PART for part in Path(name).parts):
        limit = f"{_MAX_PATH} bytes, {_MAX_PATH_PART} per name"
        raise OptionError(f"the folder's path is too long; the limit is {limit}", field="folder")
    return Path(name)
