"""The commands on the project's document as a whole, its photographs and its history, and on what a page shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from ladarreg_core.errors import OptionError
from ladarreg_core.project import edits
from ladarreg_core.project.document import CameraGiven, Part

from ...scene.person import ViewpointName
from ..state.clients import valid_name
from ..state.settings_form import check_bounds
from ..state.slices import clock
from .command import Context, PhotoIds, Positive, Reply, StepNumber, WorkbenchCommand
from .matches import PhotoCommand, step_reply

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ladarreg_core.project.document import Document

    from ..state.clients import Client

Name = Annotated[str, Meta(title="give a name")]


class SetCamera(PhotoCommand, frozen=True):
    """sets the focal length (`focal_35mm`, or `focal_mm` and `sensor_mm`, or `focal_px`), or that the photograph is a
    panorama
    """

    focal_35mm: Positive | None = None
    focal_mm: Positive | None = None
    sensor_mm: Positive | None = None
    focal_px: Positive | None = None
    model: Annotated[
        Literal["equirectangular"],
        Meta(title="the model of a camera without a file is equirectangular, without a focal length"),
    ] | None = None  # fmt: skip

    def execute(self, context: Context, client: Client) -> Reply:
        """Set it."""
        from ladarreg_core.formats.photos.exif import focal_of_35mm

        names = ("focal_px", "focal_mm", "sensor_mm", "focal_35mm")
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        if self.model is not None and given:
            raise OptionError("the model of a camera without a file is equirectangular, without a focal length")
        if self.model is None and set(given) not in (
            {"focal_px"}, {"focal_35mm"}, {"focal_mm", "sensor_mm"}, {"sensor_mm"},
        ):  # fmt: skip
            raise OptionError("give the 35 mm equivalent, or the focal length in mm and the sensor width, or pixels")
        entry = self.entry(context)
        if "focal_35mm" in given:
            size = context.loader.viewable_photo(entry).camera.size
            given = {"focal_px": focal_of_35mm(given["focal_35mm"], *size)}
        camera = msgspec.structs.replace(CameraGiven(), model=self.model, **given)
        context.queries.check_camera(entry, camera)
        return self.edit(context, client, f"Camera of {entry.source.name}", lambda p: edits.with_camera(p, camera))


class SetSettings(WorkbenchCommand, frozen=True):
    """changes settings, by their names in the slice `settings`"""

    values: dict[str, Any]

    @classmethod
    def decode(cls, message: Mapping[str, Any]) -> SetSettings:
        """Return it with all fields that are not of every message; settings check their values themselves."""
        return cls(values={name: message[name] for name in message if name not in ("id", "do", "project")})

    def execute(self, context: Context, client: Client) -> Reply:
        """Change them."""
        check_bounds(self.values)

        def edit(document: Document) -> Document:
            return msgspec.structs.replace(document, settings=document.settings.changed(self.values))

        names = ", ".join(name.replace("_", " ") for name in self.values)
        merge_key = f"settings {sorted(self.values)}"
        return step_reply(context.session.commit(f"Set {names}", edit, author=client.author, merge_key=merge_key))


class Rename(WorkbenchCommand, frozen=True):
    """renames the project"""

    name: Name

    def execute(self, context: Context, client: Client) -> Reply:
        """Rename it."""
        name = _valid(self.name)

        def edit(document: Document) -> Document:
            return msgspec.structs.replace(document, name=name)

        return step_reply(context.session.commit(f"Rename to {name}", edit, author=client.author))


class RemovePhoto(PhotoCommand, frozen=True):
    """removes a photograph"""

    def execute(self, context: Context, client: Client) -> Reply:
        """Remove it."""
        entry = self.entry(context)
        label = f"Remove {entry.source.name}"
        return step_reply(
            context.session.commit(label, lambda d: edits.without_photo(d, entry.id), author=client.author)
        )


class SetPart(WorkbenchCommand, frozen=True):
    """says how photographs take part in adjustments: `free`, `held` in their poses, or taken `out`"""

    photos: PhotoIds
    part: Annotated[Part, Meta(title="a photograph is free, held or out")]

    def execute(self, context: Context, client: Client) -> Reply:
        """Set it."""
        entries = [edits.require_photo(context.session.document, each) for each in self.photos]
        if not entries:
            raise OptionError("no photograph is chosen; choose some")
        what = entries[0].source.name if len(entries) == 1 else f"{len(entries)} photographs"
        label = {"free": "Let {} take part", "held": "Hold {}", "out": "Take out {}"}[self.part].format(what)
        return step_reply(
            context.session.commit(label, lambda d: edits.with_part(d, self.photos, self.part), author=client.author)
        )


class HoldCamera(WorkbenchCommand, frozen=True):
    """says whether adjustments keep the intrinsics of a camera as the last one left them"""

    camera: Annotated[str, Meta(title="no camera is chosen; choose one of the last adjustment")]
    held: bool

    def execute(self, context: Context, client: Client) -> Reply:
        """Set it."""
        label = f"{'Hold' if self.held else 'Release'} {self.camera}"
        return step_reply(
            context.session.commit(
                label, lambda d: edits.with_camera_held(d, self.camera, held=self.held), author=client.author
            )
        )


class UseStage(PhotoCommand, frozen=True):
    """selects the stage whose pose is shown and exported"""

    stage: Annotated[str, Meta(title="that stage has no pose yet; solve first")]

    def execute(self, context: Context, client: Client) -> Reply:
        """Select it."""
        label = f"Show {self.stage.replace('_', ' ')}"
        return self.edit(context, client, label, lambda p: edits.with_stage(p, self.stage))


class Undo(WorkbenchCommand, frozen=True):
    """takes back this client's own last edit; `n` is the step that is meant"""

    n: StepNumber | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Undo it."""
        context.session.undo(client.author, alone=context.clients.is_alone(client), number=self.n)
        return {}


class Redo(WorkbenchCommand, frozen=True):
    """restores this client's own edit that was taken back last; `n` is the step that is meant"""

    n: StepNumber | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Redo it."""
        context.session.redo(client.author, alone=context.clients.is_alone(client), number=self.n)
        return {}


class GoTo(WorkbenchCommand, frozen=True):
    """moves to a step of the history, for all clients, and tells the others who did it"""

    n: StepNumber

    def execute(self, context: Context, client: Client) -> Reply:
        """Move there."""
        was = context.session.history.edit
        context.session.go_to(self.n)
        entry = context.session.history.edit
        if entry is not was:
            context.notify_others(
                client, f"{client.name} went to '{entry.label}' of {clock(entry.when)} in the history."
            )
        return {}


class ShowPhoto(PhotoCommand, frozen=True):
    """shows another photograph to this client"""

    looks: ClassVar[bool] = True

    def execute(self, context: Context, client: Client) -> Reply:
        """Show it."""
        context.selection.show(client, self.entry(context).id)
        return {}


class SetModel(WorkbenchCommand, frozen=True):
    """changes the display of the model for this client"""

    looks: ClassVar[bool] = True
    texture: str | UnsetType = UNSET
    z_buffer: bool | UnsetType = UNSET
    detail: str | UnsetType = UNSET
    cameras: bool | UnsetType = UNSET
    matches: bool | UnsetType = UNSET
    rays: bool | UnsetType = UNSET
    residuals: bool | UnsetType = UNSET
    hidden_stations: list[str] | UnsetType = UNSET

    def execute(self, context: Context, client: Client) -> Reply:
        """Change it."""
        wanted = {name: getattr(self, name) for name in self.__struct_fields__}
        context.set_model(client, {name: value for name, value in wanted.items() if value is not UNSET})
        return {}


class CallMe(WorkbenchCommand, frozen=True):
    """renames this client"""

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "you"
    name: Name

    def execute(self, context: Context, client: Client) -> Reply:
        """Rename it."""
        context.clients.rename(client, _valid(self.name))
        return {"you": client.name}


class Look(WorkbenchCommand, frozen=True):
    """moves this client's 3-D view to a viewpoint; without an accepted pose there is none of the camera"""

    looks: ClassVar[bool] = True
    viewpoint: ViewpointName

    def execute(self, context: Context, client: Client) -> Reply:
        """Move it."""
        if context.scene is not None:
            context.scene.look(client.id, self.viewpoint)
        return {}


class ReadOnlyLink(WorkbenchCommand, frozen=True):
    """the token of the read-only link"""

    replies: ClassVar[str] = "token"

    def execute(self, context: Context, client: Client) -> Reply:
        """Return it."""
        if not context.clients.read_only_token:
            raise OptionError("this workbench has no read-only link")
        return {"token": context.clients.read_only_token}


def _valid(name: str) -> str:
    found = valid_name(name)
    if not found:
        raise OptionError("give a name")
    return found
