"""The commands of a page, by name; every command checks its fields."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, get_args

import msgspec

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.project import edits
from ladarreg_core.project.document import CameraGiven, Document, PhotoEntry

from ..argument_names import as_fields
from ..gateway.protocol import READ_ONLY
from ..jobs.registry import JobRegistry
from ..jobs.runner import JobRunner
from ..messages import internal_error
from ..scene.person import VIEWPOINTS
from ..session.loader import Loader
from ..session.session import Session
from .acquisition import Acquisition
from .acquisition_commands import ACQUISITION_COMMANDS
from .batches import Batches
from .clients import Client, Clients, valid_name
from .embedded import EmbeddedPictures
from .export_commands import EXPORT_COMMANDS
from .files import Files, HowScans
from .people_commands import PEOPLE_COMMANDS
from .queries import Queries
from .reading import reading_of
from .selection import Selection
from .settings_form import check_bounds
from .state import clock
from .station_commands import STATION_COMMANDS
from .stations import Stations

if TYPE_CHECKING:
    from ..scene import Scene3D

log = logging.getLogger(__name__)
_MAX_ACTION = 80
_OF_EVERY_MESSAGE = ("id", "do", "project")
_MAX_QUOTE, _MAX_SENTENCE = 40, 600
_FOCALS = {
    "focal_px": "the focal length",
    "focal_mm": "the focal length",
    "sensor_mm": "the sensor width",
    "focal_35mm": "the 35 mm equivalent",
}


class Context(Protocol):
    """The parts of the workbench that commands use."""

    session: Session
    loader: Loader
    selection: Selection
    clients: Clients
    queries: Queries
    files: Files
    batches: Batches
    embedded: EmbeddedPictures
    runner: JobRunner
    jobs: JobRegistry
    acquisition: Acquisition
    stations: Stations

    def set_model(self, client: Client, wanted: Mapping[str, Any]) -> None:
        """Change the display of the model for a client."""

    @property
    def scene(self) -> Scene3D | None:
        """The 3-D scene, once it is attached."""

    def list_served(self) -> None:
        """List the served folder again."""

    def tell(self, event: dict[str, Any], to: set[str]) -> None:
        """Send an event to clients by their ids."""

    def tell_others(self, client: Client, text: str) -> None:
        """Show a sentence to all other clients."""


Fields = Mapping[str, Any]
Reply = dict[str, Any]
Command = Callable[[Context, Client, Fields], Reply]


def answer(context: Context, client: Client, message: Fields) -> Reply:
    """Execute a page's command and return the reply; an error becomes a sentence."""

    def execute() -> Reply:
        do = message.get("do")
        command = COMMANDS.get(do) if isinstance(do, str) else None
        if command is None:
            raise OptionError(f"there is no command {_quoted(do)}" if do else "the message names no command")
        if client.read_only and do not in LOOKING:
            raise OptionError(READ_ONLY)
        return command(context, client, message)

    return reply_to(message, execute)


def reply_to(message: Fields, execute: Callable[[], Reply]) -> Reply:
    """Execute something and return the reply to a message; an error becomes a sentence."""
    number, do = message.get("id"), message.get("do")
    number = number if isinstance(number, int | str) else None
    try:
        return {"reply": number, "ok": True, **execute()}
    except LadarregError as error:
        return {"reply": number, "ok": False, "error": _sentence(str(error))}
    except OSError as error:
        log.warning("%s: %s", do, error)
        reason = f"system error: {(error.strerror or type(error).__name__).lower()}"
        return {
            "reply": number,
            "ok": False,
            "error": _sentence(f"{reason}; check the path, its permissions and the free space"),
        }
    except Exception as error:
        log.exception("the command %s failed", do)
        return {"reply": number, "ok": False, "error": internal_error(error, go_on="nothing else is lost, try again")}


def add_pick(context: Context, client: Client, fields: Fields) -> Reply:
    """Add a match."""
    from ladarreg_core.matches import Pick

    kind = fields.get("kind")
    if kind not in ("point", "line"):
        raise OptionError("a match is a 'point' or a 'line'")
    pick = Pick("new", kind, edits.rays(fields.get("scan")), edits.pixels(fields.get("photo_uv")))  # type: ignore[arg-type]
    made: tuple[str, ...] = ()

    def edit(photo: PhotoEntry) -> PhotoEntry:
        nonlocal made
        photo, made = edits.with_picks(photo, [pick])
        return photo

    number = _photo(context, fields).numbered + 1
    step = _edit_photo(context, client, fields, f"Draw {kind} {number}", edit)
    return {"pick": made[0], **step}


def set_pick(context: Context, client: Client, fields: Fields) -> Reply:
    """Move, enable, disable or weight a match."""
    changed: dict[str, Any] = {}
    if "scan" in fields:
        changed["scan"] = edits.rays(fields["scan"])
    if "photo_uv" in fields:
        changed["photo"] = edits.pixels(fields["photo_uv"])
    if "on" in fields:
        changed["on"] = _boolean(fields["on"])
    if "weight" in fields:
        changed["weight"] = edits.weight(fields["weight"])
    name = fields.get("pick")
    if not isinstance(name, str):
        raise OptionError("no match is selected; select one")
    entry = _photo(context, fields)
    pick = entry.pick(name)
    number = pick.number if pick else "?"
    if set(changed) == {"on"}:
        label = f"{_enable(changed['on'])} match {number}"
    else:
        label = f"{'Weight' if set(changed) == {'weight'} else 'Move'} match {number}"
    merge_key = f"{entry.id} {name} {sorted(changed)}" if "scan" in changed or "photo" in changed else ""
    return _edit_photo(
        context, client, fields, label, lambda p: edits.changed_pick(p, name, changed), merge_key=merge_key
    )


def remove_picks(context: Context, client: Client, fields: Fields) -> Reply:
    """Remove matches."""
    ids = _existing(context, fields, _pick_ids(fields.get("picks")))
    return _edit_photo(context, client, fields, f"Remove {_count(ids)}", lambda p: edits.without_picks(p, ids))


def switch_picks(context: Context, client: Client, fields: Fields) -> Reply:
    """Enable or disable matches."""
    ids, on = _pick_ids(fields.get("picks")), _boolean(fields.get("on"))
    there = _existing(context, fields, ids)
    label = f"{_enable(on)} {_count(there)}"
    return _edit_photo(context, client, fields, label, lambda p: edits.switched(p, dict.fromkeys(there, on)))


def reject(context: Context, client: Client, fields: Fields) -> Reply:
    """Disable matches whose error exceeds a threshold, and enable the others."""
    above = _positive(fields.get("above"), "the threshold")
    by = fields.get("by", "depth")
    if by not in ("depth", "px"):
        raise OptionError("the threshold applies to 'depth' or to 'px'")
    errors = context.queries.pick_errors(_photo(context, fields).id)
    name = "depth_m" if by == "depth" else "px"
    on = {pick: abs(error[name]) <= above for pick, error in errors.items() if error[name] is not None}
    if not on:
        raise OptionError("no match has an error yet; solve first")
    off = sum(not value for value in on.values())
    label = f"Disable {off} above {above:.3g} {'m' if by == 'depth' else 'px'}"
    return {"off": off, **_edit_photo(context, client, fields, label, lambda p: edits.switched(p, on))}


def set_camera(context: Context, client: Client, fields: Fields) -> Reply:
    """Set a photograph's focal length, or that it is a panorama."""
    from ladarreg_core.formats.photos.exif import focal_of_35mm

    given = {name: _positive(fields[name], what) for name, what in _FOCALS.items() if fields.get(name) is not None}
    model = fields.get("model")
    if model is not None and (given or model != "equirectangular"):
        raise OptionError("the model of a camera without a file is equirectangular, without a focal length")
    if model is None and set(given) not in ({"focal_px"}, {"focal_35mm"}, {"focal_mm", "sensor_mm"}, {"sensor_mm"}):
        raise OptionError("give the 35 mm equivalent, or the focal length in mm and the sensor width, or pixels")
    entry = _photo(context, fields)
    if "focal_35mm" in given:
        size = context.loader.viewable_photo(entry).camera.size
        given = {"focal_px": focal_of_35mm(given["focal_35mm"], *size)}
    camera = msgspec.structs.replace(CameraGiven(), model=model, **given)
    context.queries.check_camera(entry, camera)
    return _edit_photo(
        context, client, fields, f"Camera of {entry.source.name}", lambda p: edits.with_camera(p, camera)
    )


def set_settings(context: Context, client: Client, fields: Fields) -> Reply:
    """Change settings."""
    values = {name: value for name, value in fields.items() if name not in _OF_EVERY_MESSAGE}
    check_bounds(values)

    def edit(document: Document) -> Document:
        return msgspec.structs.replace(document, settings=document.settings.changed(values))

    names = ", ".join(name.replace("_", " ") for name in values)
    return _step(
        context.session.commit(f"Set {names}", edit, author=client.author, merge_key=f"settings {sorted(values)}")
    )


def rename(context: Context, client: Client, fields: Fields) -> Reply:
    """Rename the project."""
    name = _name(fields.get("name"))
    return _step(
        context.session.commit(
            f"Rename to {name}", lambda d: msgspec.structs.replace(d, name=name), author=client.author
        )
    )


def remove_photo(context: Context, client: Client, fields: Fields) -> Reply:
    """Remove a photograph from the project."""
    entry = _photo(context, fields)
    return _step(
        context.session.commit(
            f"Remove {entry.source.name}", lambda d: edits.without_photo(d, entry.id), author=client.author
        )
    )


def use_stage(context: Context, client: Client, fields: Fields) -> Reply:
    """Show the pose of another stage."""
    stage = fields.get("stage")
    label = f"Show {stage.replace('_', ' ')}" if isinstance(stage, str) else "Show"
    return _edit_photo(context, client, fields, label, lambda p: edits.with_stage(p, stage))


def undo(context: Context, client: Client, fields: Fields) -> Reply:
    """Undo the client's own last step, or one of its own by number."""
    number = None if fields.get("n") is None else _step_number(fields["n"])
    context.session.undo(client.author, alone=context.clients.is_alone(client), number=number)
    return {}


def redo(context: Context, client: Client, fields: Fields) -> Reply:
    """Redo the client's own step that was undone last."""
    number = None if fields.get("n") is None else _step_number(fields["n"])
    context.session.redo(client.author, alone=context.clients.is_alone(client), number=number)
    return {}


def go_to(context: Context, client: Client, fields: Fields) -> Reply:
    """Go to a step of the history."""
    was = context.session.history.edit
    context.session.go_to(_step_number(fields.get("n")))
    entry = context.session.history.edit
    if entry is not was:
        context.tell_others(client, f"{client.name} went to '{entry.label}' of {clock(entry.when)} in the history.")
    return {}


def show_photo(context: Context, client: Client, fields: Fields) -> Reply:
    """Show another photograph to the client."""
    context.selection.show(client, _photo(context, fields).id)
    return {}


def set_model(context: Context, client: Client, fields: Fields) -> Reply:
    """Change the display of the model for the client."""
    context.set_model(client, {name: value for name, value in fields.items() if name not in _OF_EVERY_MESSAGE})
    return {}


def call_me(context: Context, client: Client, fields: Fields) -> Reply:
    """Rename the client."""
    context.clients.rename(client, _name(fields.get("name")))
    return {"you": client.name}


def read_only_link(context: Context, client: Client, fields: Fields) -> Reply:
    """Return the token of the link with which others may look."""
    if not context.clients.read_only_token:
        raise OptionError("this workbench has no read-only link")
    return {"token": context.clients.read_only_token}


def hover_pick(context: Context, client: Client, fields: Fields) -> Reply:
    """Highlight a match in the client's 3-D view."""
    if context.scene is not None:
        context.scene.highlight(client.id, fields.get("pick") if isinstance(fields.get("pick"), str) else None)
    return {}


def look(context: Context, client: Client, fields: Fields) -> Reply:
    """Move the client's 3-D view to a viewpoint."""
    viewpoint = fields.get("viewpoint")
    known = next((name for name in VIEWPOINTS if name == viewpoint), None)
    if known is None:
        raise OptionError(f"there is no viewpoint {_quoted(viewpoint)}; it is one of {', '.join(VIEWPOINTS)}")
    if context.scene is not None:
        context.scene.look(client.id, known)
    return {}


def open_served(context: Context, client: Client, fields: Fields) -> Reply:
    """Open a file of the served folder, or several scans."""
    what, photo, given = fields.get("what"), fields.get("photo"), fields.get("paths", [fields.get("path")])
    named = isinstance(given, list) and given and all(isinstance(path, str) for path in given)
    if not named or not isinstance(what, str):
        raise OptionError("give the file to open and its kind")
    reading, how = reading_of(fields.get("reading")), _how_scans(fields)
    files = context.files
    found = [(path, path.name) for path in map(files.served_file, dict.fromkeys(given))]
    if what == "scan":
        asked = files.asks_how([name for _, name in found])
        if asked and how is None:
            return asked
        try:
            return {"opened": files.open_scans(found, how or "replace", client, reading)}
        except LadarregError as error:
            if asked is None:
                raise
            return {**asked, "said": as_fields(str(error))}
    if what == "station":
        return {"opened": files.open_scans(found, "stations", client, reading)}
    if len(found) > 1:
        raise OptionError("only scans are opened together; open the others one by one")
    ((path, name),) = found
    return {"opened": files.open(path, name, what, photo if isinstance(photo, str) else None, client, reading)}


def list_served(context: Context, client: Client, fields: Fields) -> Reply:
    """List the served folder again."""
    context.list_served()
    return {}


def open_files(context: Context, client: Client, fields: Fields) -> Reply:
    """Open uploaded files together."""
    photo = fields.get("photo")
    if photo is not None:
        photo = edits.require_photo(context.session.document, photo).id
    reading, how = reading_of(fields.get("reading")), _how_scans(fields)
    return context.batches.open(file_ids(fields), scans=how, photo=photo, reading=reading, client=client)


def add_embedded(context: Context, client: Client, fields: Fields) -> Reply:
    """Add pictures embedded in the scan's file as photographs."""
    images = fields.get("images")
    if not isinstance(images, list) or not images or not all(type(each) is int for each in images):
        raise OptionError("no pictures are chosen; choose some of the scan's")
    return {"photos": context.embedded.add(images, client)}


def discard_files(context: Context, client: Client, fields: Fields) -> Reply:
    """Delete uploaded files that are not open."""
    context.batches.discard(file_ids(fields))
    return {}


def predict(context: Context, client: Client, fields: Fields) -> Reply:
    """Predict the other side of a match under the shown pose."""
    partners = context.queries.partners(_photo(context, fields))
    if fields.get("side") == "scan":
        rows = partners.in_photo(edits.rays(fields.get("scan")))
        return {"photo_uv": _finite_rows(rows.tolist())}
    rows = partners.on_scan(edits.pixels(fields.get("photo_uv")))
    return {"scan": _finite_rows(rows.tolist())}


def where(context: Context, client: Client, fields: Fields) -> Reply:
    """Project a ray into the photograph under the shown pose."""
    partners = context.queries.partners(_photo(context, fields))
    rows = partners.in_photo(edits.rays([fields.get("scan")]))
    return {"photo_uv": _finite_rows(rows.tolist())[0]}


def snap(context: Context, client: Client, fields: Fields) -> Reply:
    """Return where a point or a line snaps to."""
    ends = edits.pixels(fields.get("ends"))
    view = fields.get("view", 0)
    scale = fields.get("px_per_screen", 1.0)
    if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 1e-3 <= scale <= 1e3:
        raise OptionError("px_per_screen is a number from 0.001 to 1000")
    view = view if isinstance(view, int) else 0
    found = context.queries.snapped(fields.get("side"), view, fields.get("photo"), ends, px_per_screen=scale)
    return {"ends": [list(end) for end in ends] if found is None else found, "found": found is not None}


def sample_line(context: Context, client: Client, fields: Fields) -> Reply:
    """Return the sample points of a line that is being drawn."""
    return context.queries.sample_line(edits.rays(fields.get("scan")))


def probe(context: Context, client: Client, fields: Fields) -> Reply:
    """Return the scan's measurement along a ray."""
    return context.queries.probe(edits.rays([fields.get("scan")])[0])


def run(context: Context, client: Client, fields: Fields) -> Reply:
    """Start a job."""
    job = fields.get("job")
    if not isinstance(job, str):
        raise OptionError("give the name of a job")
    last_solved = fields.get("last_solved") is True
    frame = fields.get("frame", "scanner")
    return {"job": context.jobs.run(job, fields.get("photo"), client.author, last_solved=last_solved, frame=frame)}


def refine(context: Context, client: Client, fields: Fields) -> Reply:
    """Start a registration from a rough pose: the given one, or the client's 3-D view."""
    if "camera_from_scanner" in fields:
        initial: Rigid | None = edits.pose(fields["camera_from_scanner"])
    else:
        initial = None if context.scene is None else context.scene.pose_of(client.id)
    if initial is None:
        raise OptionError("the 3-D view is not open yet; wait until the model is shown")
    return {"job": context.jobs.run_refine(fields.get("photo"), client.author, initial)}


def job_control(context: Context, client: Client, fields: Fields) -> Reply:
    """Pause, resume, stop, step or change the speed of the job."""
    action = fields.get("action")
    if not isinstance(action, str):
        raise OptionError("give an action: pause, resume, stop, step or speed")
    context.runner.control(action[:_MAX_ACTION], fields.get("value"))
    return {}


COMMANDS: dict[str, Command] = {
    command.__name__: command
    for command in (
        add_pick, set_pick, remove_picks, switch_picks, reject, set_camera, set_settings, rename, remove_photo,
        use_stage, undo, redo, go_to, show_photo, set_model, call_me, hover_pick, open_served, list_served, open_files,
        add_embedded, discard_files, predict, where, snap, sample_line, probe, run, refine, job_control,
        look, read_only_link, *EXPORT_COMMANDS, *PEOPLE_COMMANDS, *ACQUISITION_COMMANDS,
        *STATION_COMMANDS,
    )
}  # fmt: skip
LOOKING = frozenset(
    {
        "show_photo",
        "set_model",
        "look",
        "follow",
        "point",
        "show_view",
        "call_me",
        "hover_pick",
        "predict",
        "where",
        "snap",
        "sample_line",
        "probe",
    }
)
"""The commands of a read-only client; it is refused all others."""


def _photo(context: Context, fields: Fields) -> PhotoEntry:
    return edits.require_photo(context.session.document, fields.get("photo"))


def _edit_photo(
    context: Context,
    client: Client,
    fields: Fields,
    label: str,
    edit: Callable[[PhotoEntry], PhotoEntry],
    *,
    merge_key: str = "",
) -> Reply:
    photo = _photo(context, fields).id
    return _step(
        context.session.commit(
            label, partial(edits.edited_photo, photo_id=photo, edit=edit), author=client.author, merge_key=merge_key
        )
    )


def _step(number: int | None) -> Reply:
    """Return the reply to an edit: the number of its step, by which it can be undone; none if nothing changed."""
    return {} if number is None else {"n": number}


def _step_number(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise OptionError("a step of the history is a number of 0 or more")
    return value


def _pick_ids(value: object) -> list[str]:
    if not isinstance(value, list) or not value or not all(isinstance(name, str) for name in value):
        raise OptionError("no matches are selected; select some")
    return value


def file_ids(fields: Fields) -> list[str]:
    """Return the ids of files that a command names."""
    value = fields.get("files")
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise OptionError("no files are given; drop some")
    return value


def _how_scans(fields: Fields) -> HowScans | None:
    """Return what becomes of scans; None: not said."""
    how = fields.get("scan")
    known: HowScans | None = next((each for each in get_args(HowScans) if each == how), None)
    if known is None and how is not None:
        raise OptionError(f"scans are opened as {', '.join(get_args(HowScans))}; got {_quoted(how)}")
    return known


def _existing(context: Context, fields: Fields, ids: list[str]) -> list[str]:
    """Return those ids that are matches of the photograph, without duplicates."""
    wanted = frozenset(ids)
    return [pick.id for pick in _photo(context, fields).picks if pick.id in wanted]


def _name(value: object) -> str:
    words = valid_name(value) if isinstance(value, str) else ""
    if not words:
        raise OptionError("give a name")
    return words


def _boolean(value: object) -> bool:
    if not isinstance(value, bool):
        raise OptionError("a match is enabled with true and disabled with false")
    return value


def _enable(on: bool) -> str:
    return "Enable" if on else "Disable"


def _positive(value: object, what: str, *, most: float = 1e9) -> float:
    number = edits.finite(value)
    if number is None or not 1 / most <= number <= most:
        raise OptionError(f"{what} is {_quoted(value)}; it must be a positive number, at most {most:g}")
    return number


def _quoted(value: object) -> str:
    """Return a short quotation of any value for an error message."""
    if isinstance(value, str):
        return repr(value[:_MAX_QUOTE])
    number = edits.finite(value)
    if number is not None:
        return f"{number:g}"
    return "missing" if value is None else f"not a number ({type(value).__name__})"


def _count(ids: list[str]) -> str:
    return "a match" if len(ids) == 1 else f"{len(ids)} matches"


def _finite_rows(rows: list[list[float]]) -> list[list[float] | None]:
    return [row if all(map(math.isfinite, row)) else None for row in rows]


def _sentence(text: str) -> str:
    words = " ".join(as_fields(text).split())
    if len(words) > _MAX_SENTENCE:
        words = f"{words[:_MAX_SENTENCE]}..."
    return f"{words[:1].upper()}{words[1:]}" + ("" if words.endswith((".", "!", "?")) else ".")
