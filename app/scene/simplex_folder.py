"""Curves and controls of the simplex, in viser's panel. Source: thesis Figures 3.2 and 3.9."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from ladarreg_core.inspection.simplex_curves import CURVE_NAMES, DrawnCurves, SimplexCurves
from ladarreg_core.palette import MATCHES, REFUSED, as_css

from ..jobs.runner import FULL_SPEED, WATCHED_SPEED

if TYPE_CHECKING:
    import viser

    from .actions import SceneActions
    from .simplex_frame import SimplexFrame

TITLE = "Simplex"
BUTTONS_LABEL = "Simplex run"
PAUSE, RESUME, STEP, KEEP = "Pause", "Resume", "Step", "Keep best"
_SLIDER_FULL_SPEED = 200
"""Position of the speed slider that means full speed."""
SPEED_LABEL = "Steps per second"
ORDER = 2.0
"""Position of the folder in the panel: below the views, above the legend."""
_HEIGHT, _COST_HEIGHT = 128, 84
_AXIS_FONT = "10px system-ui, sans-serif"


class SimplexFolder:
    """The folder of the panel; hidden until the first simplex is started."""

    def __init__(
        self,
        server: viser.ViserServer,
        actions: SceneActions,
        call_or_notify: Callable[[Any, Callable[[], None]], None],
    ) -> None:
        self._folder = server.gui.add_folder(TITLE, visible=False, order=ORDER)
        self._names: tuple[str, ...] = CURVE_NAMES
        curves = SimplexCurves().snapshot()
        with self._folder:
            self._status = server.gui.add_html("")
            self._parameters = server.gui.add_uplot(
                curves.parameters,
                _series(CURVE_NAMES),
                scales={"x": {"time": False}, "m": {"auto": True}, "deg": {"auto": True}},
                axes=(_iteration_axis(), _axis("m", "m", side=3), _axis("deg", "degrees", side=1)),
                legend={"show": True, "live": False},
                cursor={"show": False},
                height=_HEIGHT,
                padding=(6, 0, 0, 0),
            )
            self._cost = server.gui.add_uplot(
                curves.cost,
                ({"label": "step"}, {"label": "log10 cost", "stroke": as_css(REFUSED), "width": 1.5, "scale": "cost"}),
                scales={"x": {"time": False}, "cost": {"auto": True}},
                axes=(_iteration_axis(), _axis("cost", "log10 cost", side=3)),
                legend={"show": False},
                cursor={"show": False},
                height=_COST_HEIGHT,
                padding=(6, 12, 0, 0),
            )
            self._buttons = server.gui.add_button_group(BUTTONS_LABEL, (PAUSE, STEP, KEEP))
            self._speed = server.gui.add_slider(
                SPEED_LABEL,
                min=1,
                max=_SLIDER_FULL_SPEED,
                step=1,
                initial_value=int(WATCHED_SPEED),
                hint=f"{_SLIDER_FULL_SPEED}: full speed",
            )

        @self._buttons.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is None:
                return
            pressed = str(self._buttons.value)
            action = {PAUSE: "pause", RESUME: "resume", STEP: "step", KEEP: "stop"}.get(pressed)
            if action is not None:
                call_or_notify(event.client, lambda: actions.job_control(action))  # type: ignore[arg-type]

        @self._speed.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                steps = int(self._speed.value)
                value = FULL_SPEED if steps >= _SLIDER_FULL_SPEED else float(steps)
                call_or_notify(event.client, lambda: actions.job_control("speed", value))

    def start(self, names: Sequence[str], curves: DrawnCurves) -> None:
        """Show the folder with empty curves."""
        if tuple(names) != self._names:
            self._names = tuple(names)
            self._parameters.series = _series(names)
        self._parameters.data, self._cost.data = curves.parameters, curves.cost
        self.show_state("running")
        self._set_status("starting", None)
        self._folder.visible = True

    def draw(self, curves: DrawnCurves, frame: SimplexFrame, state: str) -> None:
        """Draw the curves so far."""
        self._parameters.data, self._cost.data = curves.parameters, curves.cost
        self._set_status(state, frame)

    def show_state(self, state: str) -> None:
        """Show the buttons of a state: `running`, `paused`, or any other once it has ended."""
        self._buttons.options = (RESUME if state == "paused" else PAUSE, STEP, KEEP)
        self._buttons.visible = self._speed.visible = state in ("running", "paused")

    def hide(self) -> None:
        """Hide the folder."""
        self._folder.visible = False

    def _set_status(self, state: str, frame: SimplexFrame | None) -> None:
        step = "" if frame is None else f" · step {frame.iteration}"
        figures = "" if frame is None else " · ".join(filter(None, (f"cost {frame.cost:.2e}", frame.note)))
        self._status.content = (
            f'<div class="lr lr-simplex"><b data-state="{html.escape(state)}">{html.escape(state)}</b>'
            f"<span>{html.escape(step)}<br>{html.escape(figures)}</span></div>"
        )


def _series(names: Sequence[str]) -> tuple[Any, ...]:
    curves: list[dict[str, Any]] = [{"label": "step"}]
    for k, (name, colour) in enumerate(zip(names, MATCHES, strict=True)):
        curves.append({
            "label": name, "stroke": as_css(colour), "width": 1.5, "scale": "m" if k < 3 else "deg",
            # The dashes distinguish curves whose colours look alike to some people.
            **({} if k < 3 else {"dash": (6, 3)}),
        })  # fmt: skip
    return tuple(curves)


def _axis(scale: str, label: str, *, side: int) -> Any:
    return {
        "scale": scale, "side": side, "label": label, "labelSize": 12, "labelFont": _AXIS_FONT, "font": _AXIS_FONT,
        "size": 38, "space": 24, "gap": 3, "ticks": {"size": 3}, "grid": {"show": side == 3, "width": 1},
    }  # fmt: skip


def _iteration_axis() -> Any:
    return {"font": _AXIS_FONT, "size": 20, "gap": 2, "space": 28, "ticks": {"size": 3}, "grid": {"width": 1}}
