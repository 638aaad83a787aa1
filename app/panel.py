"""The viewer's panel: the verdict, the pose with its sigmas, and the few controls of the scene."""

from __future__ import annotations

import html
import math
from typing import TYPE_CHECKING

from app import wording
from app.scene import Scene, Stage, Standpoint
from app.static_files import static_text

if TYPE_CHECKING:
    import viser

    from ladarreg_core.results import Registration

ACCENT = (92, 200, 255)
VIEWS = {"Overview": Stage.overview, "Scanner": Stage.from_scanner, "Camera": Stage.from_camera}
BLEND_LABEL = "Laser to colour"


def add_panel(server: viser.ViserServer, scene: Scene, stage: Stage, *, share: float) -> None:
    """Fill viser's panel. Names from files reach the page through `html.escape` only."""
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=ACCENT)
    server.gui.add_html(_style() + panel_html(stage.registration, stage.scan.name, stage.photo.name))
    accepted = stage.registration.accepted

    blend = server.gui.add_slider(
        BLEND_LABEL, min=0.0, max=1.0, step=0.05, initial_value=share, disabled=not accepted,
        hint="0: the laser's intensity, 1: the photograph's colour",
    )  # fmt: skip
    blend.on_update(lambda _: scene.blend(float(blend.value)))

    views = server.gui.add_button_group("Look from", tuple(VIEWS) if accepted else ("Overview", "Scanner"))

    cameras = server.gui.add_checkbox("Cameras", initial_value=True)
    cameras.on_update(lambda _: scene.show_cameras(visible=bool(cameras.value)))
    lines = server.gui.add_checkbox("Match lines", initial_value=True, disabled=not accepted)
    lines.on_update(lambda _: scene.show_matches(visible=bool(lines.value)))

    @views.on_click
    def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
        if event.client is None:
            return
        name = str(views.value)
        # From inside, the frustum's own picture would hide the scene.
        outside = name == "Overview"
        cameras.value = outside  # type: ignore[misc]
        lines.value = outside and accepted  # type: ignore[misc]
        _stand(event.client, VIEWS[name](stage))


def panel_html(result: Registration, scan_name: str, photo_name: str) -> str:
    """Return the verdict, the six numbers and what was registered, as HTML."""
    kind = "ok" if result.accepted else "bad"
    reasons = "".join(f"<p>{html.escape(wording.one_line(reason))}</p>" for reason in result.reasons)
    parts = [
        f'<div class="lr-head">{static_text("logo.svg")}<span>{html.escape(scan_name)}</span> <b>+</b> '
        f"<span>{html.escape(photo_name)}</span></div>",
        f'<div class="lr-verdict {kind}" role="status"><strong>{html.escape(wording.verdict(result))}</strong>'
        f"{reasons}</div>",
    ]
    if result.accepted:
        parts += [
            f'<div class="lr-six">{"".join(_number(*row) for row in _six(result))}</div>',
            f'<p class="lr-words">{html.escape(wording.position(result))}.<br>{html.escape(wording.turn(result))}.<br>'
            f"{html.escape(wording.matches(result))}.</p>",
        ]
    return f'<div class="lr">{"".join(parts)}</div>'


def _six(result: Registration) -> list[tuple[str, float, float, int]]:
    values, sigmas = result.thesis_parameters, result.thesis_sigmas
    lengths = [(f"{name} m", getattr(values, name), getattr(sigmas, name), 3) for name in ("Tx", "Ty", "Tz")]
    angles = [
        (f"{sign} deg", math.degrees(getattr(values, name)), math.degrees(getattr(sigmas, name)), 2)
        for name, sign in (("alpha", "α"), ("beta", "β"), ("gamma", "γ"))
    ]
    return lengths + angles


def _number(name: str, value: float, sigma: float, digits: int) -> str:
    shown = f"{value:.{digits}f}".replace("-", "−")
    spread = f"{sigma:.1g}"
    return f"<div><span>{html.escape(name)}</span><em>{shown}</em><i>± {spread}</i></div>"


def _style() -> str:
    return f"<style>{static_text('tokens.css')}{static_text('panel.css')}</style>"


def _stand(client: viser.ClientHandle, there: Standpoint) -> None:
    with client.atomic():
        client.camera.up_direction = there.up
        client.camera.position = there.position
        client.camera.look_at = there.look_at
        client.camera.fov = there.fov_rad
