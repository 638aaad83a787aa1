"""What a page may ask for, by name; every command checks what it is given."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project import edits
from ladarreg_core.project.document import CameraGiven, Document, PhotoEntry

if TYPE_CHECKING:
    from .workbench import Person, Workbench

Fields = Mapping[str, Any]
Answer = dict[str, Any]
Command = Callable[["Workbench", "Person", Fields], Answer]
log = logging.getLogger(__name__)
_MOST_NAME = 80
_MOST_PATH, _MOST_PART = 4000, 255
_QUOTED, _LONGEST_SENTENCE = 40, 600
_FOCALS = {
    "focal_px": "the focal length",
    "focal_mm": "the focal length",
    "sensor_mm": "the sensor's width",
    "focal_35mm": "the 35 mm equivalent",
}


def answer(workbench: Workbench, person: Person, message: Fields) -> Answer:
    """Do what a page asks for and return its reply; whatever goes wrong is a sentence."""
    number, do = message.get("id"), message.get("do")
    number = number if isinstance(number, int | str) else None
    command = COMMANDS.get(do) if isinstance(do, str) else None
    try:
        if command is None:
            raise OptionError(f"there is no command {_shown(do)}")
        return {"reply": number, "ok": True, **command(workbench, person, message)}
    except LadarregError as error:
        return {"reply": number, "ok": False, "error": _sentence(str(error))}
    except OSError as error:
        log.warning("%s: %s", do, error)
        reason = f"the system refuses: {(error.strerror or type(error).__name__).lower()}"
        return {
            "reply": number,
            "ok": False,
            "error": _sentence(f"{reason}; check the path, its permissions and the space"),
        }
    except Exception as error:
        workbench.log_fault(error)
        return {"reply": number, "ok": False, "error": f"This is a fault of the program ({type(error).__name__})."}


def add_pick(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Put down a match."""
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

    number = edits.the_photo(workbench.session.document, fields.get("photo")).numbered + 1
    _edit_photo(workbench, person, fields, f"Draw {kind} {number}", edit)
    return {"pick": made[0]}


def set_pick(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Move a match, switch it, or weigh it."""
    changed: dict[str, Any] = {}
    if "scan" in fields:
        changed["scan"] = edits.rays(fields["scan"])
    if "photo_uv" in fields:
        changed["photo"] = edits.pixels(fields["photo_uv"])
    if "on" in fields:
        changed["on"] = _switch(fields["on"])
    if "weight" in fields:
        changed["weight"] = edits.weight(fields["weight"])
    name = fields.get("pick")
    if not isinstance(name, str):
        raise OptionError("say which match; none is chosen")
    entry = edits.the_photo(workbench.session.document, fields.get("photo"))
    pick = entry.pick(name)
    number = pick.number if pick else "?"
    if set(changed) == {"on"}:
        label = f"Switch {'on' if changed['on'] else 'off'} match {number}"
    else:
        label = f"{'Weigh' if set(changed) == {'weight'} else 'Move'} match {number}"
    moves = f"{entry.id} {name} {sorted(changed)}" if "scan" in changed or "photo" in changed else ""
    _edit_photo(workbench, person, fields, label, lambda p: edits.changed_pick(p, name, changed), one_move=moves)
    return {}


def remove_picks(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Remove matches."""
    ids = _names(fields.get("picks"))
    there = _those_there(workbench, fields, ids)
    _edit_photo(workbench, person, fields, f"Remove {_count(there)}", lambda p: edits.without_picks(p, there))
    return {}


def switch_picks(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Switch matches on or off."""
    ids, on = _names(fields.get("picks")), _switch(fields.get("on"))
    there = _those_there(workbench, fields, ids)
    label = f"Switch {'on' if on else 'off'} {_count(there)}"
    _edit_photo(workbench, person, fields, label, lambda p: edits.switched(p, dict.fromkeys(there, on)))
    return {}


def reject(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Switch off what lies above a threshold, and on what lies below."""
    above = _positive(fields.get("above"), "the threshold")
    by = fields.get("by", "depth")
    if by not in ("depth", "px"):
        raise OptionError("matches are rejected by 'depth' or by 'px'")
    entry = edits.the_photo(workbench.session.document, fields.get("photo"))
    judged = workbench.judged(entry.id)["by_pick"]
    name = "depth_m" if by == "depth" else "px"
    on = {pick: abs(said[name]) <= above for pick, said in judged.items() if said[name] is not None}
    if not on:
        raise OptionError("no match has an error yet; solve first")
    off = sum(not value for value in on.values())
    label = f"Reject {off} above {above:.3g} {'m' if by == 'depth' else 'px'}"
    _edit_photo(workbench, person, fields, label, lambda p: edits.switched(p, on))
    return {"off": off}


def set_camera(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Tell a photograph's focal length."""
    from ladarreg_core.formats.exif import focal_of_35mm

    given = {name: _positive(fields[name], said) for name, said in _FOCALS.items() if fields.get(name) is not None}
    if set(given) not in ({"focal_px"}, {"focal_35mm"}, {"focal_mm", "sensor_mm"}):
        raise OptionError("give the 35 mm equivalent, or the focal length in mm and the sensor's width, or pixels")
    if "focal_35mm" in given:
        entry = edits.the_photo(workbench.session.document, fields.get("photo"))
        size = workbench.room.photo_to_look_at(entry).camera.size
        given = {"focal_px": focal_of_35mm(given["focal_35mm"], *size)}
    _camera(workbench, person, fields, msgspec.structs.replace(CameraGiven(), **given))
    return {}


def set_settings(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Change thresholds and choices."""
    from .settings_form import check_bounds

    values = {name: value for name, value in fields.items() if name not in ("id", "do")}
    check_bounds(values)

    def edit(document: Document) -> Document:
        return msgspec.structs.replace(document, settings=document.settings.changed(values))

    names = ", ".join(name.replace("_", " ") for name in values)
    workbench.session.commit(f"Set {names}", edit, author=person.name, one_move=f"settings {sorted(values)}")
    return {}


def rename(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Rename the project."""
    name = _name(fields.get("name"))
    workbench.session.commit(f"Rename to {name}", lambda d: msgspec.structs.replace(d, name=name), author=person.name)
    return {}


def remove_photo(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Take a photograph out of the project."""
    entry = edits.the_photo(workbench.session.document, fields.get("photo"))
    workbench.session.commit(
        f"Remove {entry.source.name}", lambda d: edits.without_photo(d, entry.id), author=person.name
    )
    return {}


def use_stage(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Have another stage's answer count."""
    stage = fields.get("stage")
    label = f"Show {stage.replace('_', ' ')}" if isinstance(stage, str) else "Show"
    _edit_photo(workbench, person, fields, label, lambda p: edits.with_stage(p, stage))
    return {}


def undo(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Take the last step back."""
    workbench.session.undo()
    return {}


def redo(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Take it again."""
    workbench.session.redo()
    return {}


def go_to(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Go to a step of the history."""
    number = fields.get("n")
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 2**53:
        raise OptionError("a step of the history is a number of 0 or more")
    workbench.session.go_to(number)
    return {}


def show_photo(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Have everybody look at another photograph."""
    workbench.show_photo(edits.the_photo(workbench.session.document, fields.get("photo")).id)
    return {}


def set_model(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Change what the 3-D scene shows."""
    workbench.set_model({name: value for name, value in fields.items() if name not in ("id", "do")})
    return {}


def call_me(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Say who one is."""
    workbench.rename_person(person, _name(fields.get("name")))
    return {"you": person.name}


def hover_pick(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Highlight a match in the 3-D scene."""
    workbench.highlight(fields.get("pick") if isinstance(fields.get("pick"), str) else None)
    return {}


def open_served(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Open a file of the served folder."""
    path, what, photo = fields.get("path"), fields.get("what"), fields.get("photo")
    if not isinstance(path, str) or not isinstance(what, str):
        raise OptionError("say which file to open, and as what")
    opened = workbench.open_served(path, what, photo if isinstance(photo, str) else None, person)
    return {"opened": opened}


def list_served(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Look again which files are served."""
    workbench.list_served()
    return {}


def predict(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Return the partner under the shown pose."""
    entry = edits.the_photo(workbench.session.document, fields.get("photo"))
    partners = workbench.partners(entry)
    if fields.get("side") == "scan":
        rows = partners.in_photo(edits.rays(fields.get("scan")))
        return {"photo_uv": _or_none(rows.tolist())}
    rows = partners.on_scan(edits.pixels(fields.get("photo_uv")))
    return {"scan": _or_none(rows.tolist())}


def where(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Return where the shown pose puts a ray."""
    entry = edits.the_photo(workbench.session.document, fields.get("photo"))
    rows = workbench.partners(entry).in_photo(edits.rays([fields.get("scan")]))
    return {"photo_uv": _or_none(rows.tolist())[0]}


def snap(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Return the corner next to a pixel."""
    at = edits.pixels([fields.get("at")])[0]
    view = fields.get("view", 0)
    found = workbench.corner_near(fields.get("side"), view if isinstance(view, int) else 0, fields.get("photo"), at)
    return {"at": list(at) if found is None else found, "found": found is not None}


def sample_line(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Return the samples of a line that is being drawn."""
    return workbench.sampled(edits.rays(fields.get("scan")))


def probe(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Return what the scan measured along a ray."""
    return workbench.probed(edits.rays([fields.get("scan")])[0])


def run(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Begin a job."""
    job = fields.get("job")
    if not isinstance(job, str):
        raise OptionError("say which job")
    return {"job": workbench.run(job, fields.get("photo"), person)}


def job_control(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Pause, resume, stop, step or slow down the job."""
    action = fields.get("action")
    if not isinstance(action, str):
        raise OptionError("say what the job shall do: pause, resume, stop, step or speed")
    workbench.runner.control(action[:_MOST_NAME], fields.get("value"))
    return {}


def export_folder(workbench: Workbench, person: Person, fields: Fields) -> Answer:
    """Write the results into a folder of the server's machine."""
    folder = _folder(fields.get("folder"))
    return {"job": workbench.run_export(folder, fields.get("photo"), person, force=fields.get("force") is True)}


COMMANDS: dict[str, Command] = {
    command.__name__: command
    for command in (
        add_pick, set_pick, remove_picks, switch_picks, reject, set_camera, set_settings, rename, remove_photo,
        use_stage, undo, redo, go_to, show_photo, set_model, call_me, hover_pick, open_served, list_served, predict,
        where, snap, sample_line, probe, run, job_control, export_folder,
    )
}  # fmt: skip


def _edit_photo(
    workbench: Workbench,
    person: Person,
    fields: Fields,
    label: str,
    edit: Callable[[PhotoEntry], PhotoEntry],
    *,
    one_move: str = "",
) -> None:
    photo = edits.the_photo(workbench.session.document, fields.get("photo")).id
    workbench.session.commit(
        label, partial(edits.edited_photo, photo_id=photo, edit=edit), author=person.name, one_move=one_move
    )


def _camera(workbench: Workbench, person: Person, fields: Fields, camera: CameraGiven) -> None:
    entry = edits.the_photo(workbench.session.document, fields.get("photo"))
    workbench.check_camera(entry, camera)
    _edit_photo(workbench, person, fields, f"Camera of {entry.source.name}", lambda p: edits.with_camera(p, camera))


def _names(value: object) -> list[str]:
    if not isinstance(value, list) or not value or not all(isinstance(name, str) for name in value):
        raise OptionError("say which matches; none is chosen")
    return value


def _those_there(workbench: Workbench, fields: Fields, ids: list[str]) -> list[str]:
    """Return which of some ids are matches of the photograph, each once."""
    wanted = frozenset(ids)
    return [
        pick.id for pick in edits.the_photo(workbench.session.document, fields.get("photo")).picks if pick.id in wanted
    ]


def _folder(value: object) -> Path:
    """Return the path of a folder, if a system could have one of that name."""
    text = value.strip() if isinstance(value, str) else ""
    if not text:
        raise OptionError("give the folder that the results shall go to")
    if not text.isprintable():
        raise OptionError("the folder's path holds control characters; write it anew")
    if len(text.encode()) > _MOST_PATH or any(len(part.encode()) > _MOST_PART for part in Path(text).parts):
        raise OptionError(f"the folder's path is too long: {_MOST_PATH} bytes are the most, {_MOST_PART} for each name")
    return Path(text)


def _name(value: object) -> str:
    words = " ".join(str(value).split()) if isinstance(value, str) else ""
    words = "".join(c for c in words if c.isprintable())[:_MOST_NAME]
    if not words:
        raise OptionError("give a name")
    return words


def _switch(value: object) -> bool:
    if not isinstance(value, bool):
        raise OptionError("a switch is on or off")
    return value


def _positive(value: object, what: str, *, most: float = 1e9) -> float:
    number = edits.finite(value)
    if number is None or not 1 / most <= number <= most:
        raise OptionError(f"{what} is {_shown(value)}; it must be a positive number, at most {most:g}")
    return number


def _shown(value: object) -> str:
    """Return a value as an error quotes it: short, whatever a page sent."""
    if isinstance(value, str):
        return repr(value[:_QUOTED])
    number = edits.finite(value)
    if number is not None:
        return f"{number:g}"
    return "nothing" if value is None else f"no number ({type(value).__name__})"


def _count(ids: list[str]) -> str:
    return "a match" if len(ids) == 1 else f"{len(ids)} matches"


def _or_none(rows: list[list[float]]) -> list[list[float] | None]:
    return [row if all(map(math.isfinite, row)) else None for row in rows]


def _sentence(text: str) -> str:
    words = " ".join(text.split())
    if len(words) > _LONGEST_SENTENCE:
        words = f"{words[:_LONGEST_SENTENCE]}..."
    return f"{words[:1].upper()}{words[1:]}" + ("" if words.endswith((".", "!", "?")) else ".")
