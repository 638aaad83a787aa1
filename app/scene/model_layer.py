"""The textured model, replaced without flicker."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ladarreg_core.export.glb import glb_bytes
from ladarreg_core.inspection.model_textures import Legend, colored_points

if TYPE_CHECKING:
    import viser

    from ladarreg_core.inspection.model_textures import ModelTexture

    from .draw_queue import DrawQueue
    from .subject import RenderChoice, ScanShown, Subject

REPLACED_AFTER_S, REPLACED_BY_DRAFT_AFTER_S = 2.0, 0.8
_POINT_SIZE_PER_RANGE = 0.004


class ModelLayer:
    """The model as last requested.

    viser cannot replace a texture alone, and a model disappears while the browser parses its successor. The new model
    is therefore added under another name, and the old one removed a little later; where both coincide, the newer is
    drawn.
    """

    def __init__(self, server: viser.ViserServer, queue: DrawQueue) -> None:
        self._server = server
        self._queue = queue
        self._nodes: list[viser.SceneNodeHandle] = []
        self._scan: ScanShown | None = None
        self._drawn: tuple[object, ...] = ()
        self._legend = Legend("")
        self._count = 0

    @property
    def legend(self) -> Legend:
        """Legend of the texture that is drawn."""
        return self._legend

    def needs_texture(self, subject: Subject | None, choice: RenderChoice) -> bool:
        """Return whether the requested texture differs from the one that is drawn."""
        if subject is None:
            return False
        return subject.shown is not self._scan or self._drawn[:1] != (_texture_key(subject, choice),)

    def draw(self, subject: Subject | None, choice: RenderChoice) -> None:
        """Draw the model, unless it is already drawn."""
        if subject is None or subject.shown is not self._scan:
            self.clear()
        if subject is None:
            return
        requested = _texture_key(subject, choice), choice.most_vertices
        if self._drawn == requested:
            return
        texture = subject.texture(choice)
        self._count += 1
        self._nodes.append(self._add(f"/model/{self._count}", subject, choice, texture))
        self._scan, self._drawn, self._legend = subject.shown, requested, texture.legend
        after_s = REPLACED_BY_DRAFT_AFTER_S if choice.draft else REPLACED_AFTER_S
        self._queue.request("replaced model", self._remove_replaced, after_s=after_s)

    def clear(self) -> None:
        """Remove all models."""
        for node in self._nodes:
            node.remove()
        self._nodes, self._scan, self._drawn, self._legend = [], None, (), Legend("")

    def _add(self, name: str, subject: Subject, choice: RenderChoice, texture: ModelTexture) -> viser.SceneNodeHandle:
        mesh = subject.shown.mesh(choice)
        if len(mesh.faces):
            data = glb_bytes(mesh, texture.image, for_viser=True, largest_texture_px=choice.most_texture_px)
            return self._server.scene.add_glb(name, data, cast_shadow=False, receive_shadow=False)
        points, colours = colored_points(subject.scan, texture.image, most=choice.most_vertices)
        return self._server.scene.add_point_cloud(
            name,
            points,
            colours,
            point_size=_POINT_SIZE_PER_RANGE * subject.shown.range_m,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def _remove_replaced(self) -> None:
        while len(self._nodes) > 1:
            self._nodes.pop(0).remove()


def _texture_key(subject: Subject, choice: RenderChoice) -> tuple[object, ...]:
    """Return everything that determines the model's texture."""
    kind = subject.texture_kind(choice)
    of_pose = (subject.photo, subject.result) if kind not in ("intensity", "range") else ()
    return (kind, choice.z_buffer if kind == "colour" else None, *of_pose)
