"""viser's panel beside the scene: viewpoints, settings of the model, and the legend of its colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError
from ladarreg_core.inspection.model_textures import texture_choices
from ladarreg_core.palette import ACCENT

from ..gateway.pages import static_text
from .legend import legend_html

if TYPE_CHECKING:
    import viser

    from ladarreg_core.inspection.model_textures import Legend
    from ladarreg_core.results import PoseResult

    from .actions import SceneActions
    from .subject import RenderChoice

OVERVIEW, SCANNER, CAMERA = "Overview", "Scanner", "Camera"
VIEWS_LABEL, TEXTURE_LABEL, MODEL_TITLE = "Viewpoint", "Texture", "Model"
SWITCHES = {
    "z_buffer": (
        "Hide occluded",
        "off: the photograph also colours hidden surfaces, as in thesis Figure 2.23",
    ),
    "light": ("Coarse mesh", "fewer vertices and a smaller texture, for slow browsers"),
    "cameras": ("Cameras", "the frusta of the scanner and the camera"),
    "matches": ("Matches", "the matches with their rays"),
}
SIZE_LABEL = "Match size"


class Panel:
    """The controls: changes go to the workbench, and come back through `show`."""

    def __init__(
        self,
        server: viser.ViserServer,
        actions: SceneActions,
        *,
        set_viewpoint: Callable[[viser.ClientHandle, str], None],
        set_match_size: Callable[[float], None],
    ) -> None:
        self._server = server
        gui = server.gui
        gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=ACCENT, control_width="small"
        )
        gui.add_html(f"<style>{static_text('tokens.css')}{static_text('panel.css')}</style>", order=0)
        self._views = gui.add_button_group(VIEWS_LABEL, (OVERVIEW, SCANNER), order=1)
        self._legend = gui.add_html("", order=3)
        # The page has these controls too; the folder is for the scene opened on its own.
        self._folder = gui.add_folder(MODEL_TITLE, expand_by_default=False, order=4)
        self._labels: dict[str, str] = {choice.label: choice.kind for choice in texture_choices(None)}
        self._switches: dict[str, viser.GuiCheckboxHandle] = {}
        with self._folder:
            self._texture = gui.add_dropdown(TEXTURE_LABEL, tuple(self._labels))
            for name, (label, hint) in SWITCHES.items():
                self._switches[name] = gui.add_checkbox(label, initial_value=name != "light", hint=hint)
            self._size = gui.add_slider(SIZE_LABEL, min=0.25, max=4.0, step=0.25, initial_value=1.0)

        @self._views.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                set_viewpoint(event.client, str(self._views.value))

        @self._texture.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                kind = self._labels[str(self._texture.value)]
                self.call_or_notify(event.client, lambda: actions.set_model(texture=kind))

        for name, switch in self._switches.items():

            @switch.on_update
            def _(event: viser.GuiEvent[Any], name: str = name, switch: viser.GuiCheckboxHandle = switch) -> None:
                if event.client is not None:
                    setting: dict[str, Any] = {name: bool(switch.value)}
                    self.call_or_notify(event.client, lambda: actions.set_model(**setting))

        @self._size.on_update
        def _(_: viser.GuiEvent[Any]) -> None:
            set_match_size(float(self._size.value))

    @staticmethod
    def call_or_notify(client: viser.ClientHandle, action: Callable[[], None]) -> None:
        """Call an action; if it is refused, notify the client that requested it."""
        try:
            action()
        except LadarregError as error:
            client.add_notification("Not possible", str(error), auto_close_seconds=8.0, color="yellow")

    def show(self, choice: RenderChoice, result: PoseResult | None, legend: Legend, *, has_camera: bool) -> None:
        """Set the controls to what is drawn."""
        # viser calls the callbacks for these changes too, without a client; they are ignored above to prevent a loop.
        label = next(label for label, kind in self._labels.items() if kind == choice.texture)
        if self._texture.value != label:
            self._texture.value = label  # type: ignore[misc]
        for name, switch in self._switches.items():
            if bool(switch.value) != getattr(choice, name):
                switch.value = getattr(choice, name)  # type: ignore[misc]
        self._switches["z_buffer"].disabled = not (has_camera and choice.texture == "colour")
        views = (OVERVIEW, SCANNER, CAMERA) if has_camera else (OVERVIEW, SCANNER)
        if self._views.options != views:
            self._views.options = views
        missing = next((c for c in texture_choices(result) if c.kind == choice.texture and not c.usable), None)
        note = "" if missing is None else f"{missing.label} {missing.description}"
        self._legend.content = legend_html(legend, note)
