"""The textured model, exchanged without a flicker."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ladarreg_core.export.glb import glb_bytes
from ladarreg_core.inspection.model_textures import Legend, colored_points

if TYPE_CHECKING:
    import viser

    from ladarreg_core.inspection.model_textures import ModelTexture

    from .draw_queue import Wishes
    from .subject import ModelNow, ScanShown, Subject

REPLACED_AFTER_S, REPLACED_BY_COARSE_AFTER_S = 2.0, 0.8
_POINT_OF_RANGE = 0.004


class ModelLayer:
    """The model as it was last wished.

    viser cannot exchange a texture alone, and a model disappears while its successor is parsed: so the next one is
    added under another name and the last one taken away a little later. Lying in the same place, the newer is drawn.
    """

    def __init__(self, server: viser.ViserServer, wishes: Wishes) -> None:
        self._server = server
        self._wishes = wishes
        self._nodes: list[viser.SceneNodeHandle] = []
        self._scan: ScanShown | None = None
        self._drawn: tuple[object, ...] = ()
        self._legend = Legend("")
        self._count = 0

    @property
    def legend(self) -> Legend:
        """Of what is drawn."""
        return self._legend

    def is_news(self, subject: Subject | None, choice: ModelNow) -> bool:
        """Return whether another picture is to be painted on the model than is there."""
        if subject is None:
            return False
        return subject.shown is not self._scan or self._drawn[:1] != (_painted(subject, choice),)

    def draw(self, subject: Subject | None, choice: ModelNow) -> None:
        """Draw the model, if it is not there already."""
        if subject is None or subject.shown is not self._scan:
            self.clear()
        if subject is None:
            return
        wanted = _painted(subject, choice), choice.most_vertices
        if self._drawn == wanted:
            return
        texture = subject.texture(choice)
        self._count += 1
        self._nodes.append(self._add(f"/model/{self._count}", subject, choice, texture))
        self._scan, self._drawn, self._legend = subject.shown, wanted, texture.legend
        after_s = REPLACED_BY_COARSE_AFTER_S if choice.coarse else REPLACED_AFTER_S
        self._wishes.wish("replaced model", self._remove_replaced, after_s=after_s)

    def clear(self) -> None:
        """Take every model away."""
        for node in self._nodes:
            node.remove()
        self._nodes, self._scan, self._drawn, self._legend = [], None, (), Legend("")

    def _add(self, name: str, subject: Subject, choice: ModelNow, texture: ModelTexture) -> viser.SceneNodeHandle:
        mesh = subject.shown.mesh(choice)
        if len(mesh.faces):
            data = glb_bytes(mesh, texture.image, for_viser=True, largest_texture_px=choice.most_texture_px)
            return self._server.scene.add_glb(name, data, cast_shadow=False, receive_shadow=False)
        points, colours = colored_points(subject.scan, texture.image, most=choice.most_vertices)
        return self._server.scene.add_point_cloud(
            name,
            points,
            colours,
            point_size=_POINT_OF_RANGE * subject.shown.range_m,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def _remove_replaced(self) -> None:
        while len(self._nodes) > 1:
            self._nodes.pop(0).remove()


def _painted(subject: Subject, choice: ModelNow) -> tuple[object, ...]:
    """Return all that the picture on the model is made of."""
    kind = subject.texture_kind(choice)
    of_pose = (subject.photo, subject.result) if kind not in ("intensity", "range") else ()
    return (kind, choice.z_buffer if kind == "colour" else None, *of_pose)
