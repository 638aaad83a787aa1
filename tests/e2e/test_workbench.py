"""The workbench in a browser, with a mouse and the embedded sample."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import sys
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.audits import hard_to_read, lost_without_a_mouse
from testing.workbench.operator import Operator, at_work
from testing.workbench.pages import two_frames, wait_for_store, without_model
from testing.workbench.served import Page as Socket
from testing.workbench.served import served
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser, WebSocketRoute

WRONG = re.compile("damaged|truncated|cut short|incomplete|cannot be read|not an image|no picture", re.IGNORECASE)
SIZE = {"width": 1600, "height": 900}
OPEN = "dialog[open], [popover]:popover-open"


def seen_by_both() -> list[tuple[Any, Any, Any]]:
    """Return three lines that scan and photo share: view pixels, photo pixels, rays; from the sample's true pose."""
    import ladarreg_core as lr
    from ladarreg_core.inspection.pictures import inspection_views

    folder = sample_folder()
    scan = lr.read_scan(folder / "scan.npz")
    photo = lr.read_photo(next(folder.glob("photo.*")), camera=folder / "camera.json")
    truth = lr.Rigid.from_matrix(json.loads((folder / "truth.json").read_text())["camera_from_scanner"])
    view = inspection_views(scan)[0].view
    rng = np.random.default_rng(4)
    found: list[tuple[Any, Any, Any]] = []
    while len(found) < 3:
        uv = rng.uniform((200, 150), (view.camera.width - 200, view.camera.height - 150), (2, 2)).round(1)
        rays = view.rays_at(uv)
        cell = np.rint(scan.geometry.cell_of(rays)).astype(int)
        ranges = scan.ranges[cell[:, 0], cell[:, 1]]
        there = photo.camera.project(truth @ (rays * ranges[:, None]))
        inside = photo.camera.contains(there, border=-40).all() if np.isfinite(there).all() else False
        if inside and 150 < np.linalg.norm(uv[0] - uv[1]) < 500:
            found.append((uv.tolist(), there.round(1).tolist(), rays.tolist()))
    return found


@pytest.mark.slow
def test_the_whole_workflow(operator: Operator, browser: Browser, tmp_path: Path) -> None:
    """Draw, undo, delete, register, run the simplex, disable outliers, inspect, export; with a second client."""
    page = operator.page
    page.keyboard.press("n")  # no snapping, since positions are checked to fractions of a pixel
    operator.shot("opened")
    for number, (in_scan, in_photo, rays) in enumerate(seen_by_both(), 1):
        operator.draw("scan", in_scan)
        operator.draw("photo", in_photo)
        picks = operator.wait(
            lambda n=number: p if len(p := operator.slice("picks:p1")) == n else None, f"line {number} in the document"
        )
        drawn = picks[-1]
        assert drawn["kind"] == "line"
        np.testing.assert_allclose(drawn["photo"], in_photo, atol=0.05)
        np.testing.assert_allclose(drawn["scan"], rays, atol=1e-4)
    operator.shot("three-lines")

    page.keyboard.press("Control+z")
    operator.wait(lambda: len(operator.slice("picks:p1")) == 2, "undo")
    page.keyboard.press("Control+Shift+z")
    operator.wait(lambda: len(operator.slice("picks:p1")) == 3, "redo")
    page.locator(".row-line[data-pick]").nth(2).locator(".col-kind").click()
    page.keyboard.press("Delete")
    operator.wait(lambda: len(operator.slice("picks:p1")) == 2, "delete")

    operator.button("Register automatically").click()
    operator.wait(lambda: operator.slice("poses:p1")["shown"] == "auto", "registered", 240)
    assert operator.slice("photos")[0]["state"] == "accepted"
    page.get_by_text("Accepted", exact=False).first.wait_for()
    assert len(operator.slice("picks:p1")) > 30
    operator.shot("registered")

    other = browser.new_context(viewport=SIZE, bypass_csp=True)  # type: ignore[arg-type]
    second = other.new_page()
    without_model(second)
    second.goto(f"{operator.server.address}?token={operator.server.token}")
    second.locator(".row-line[data-pick]").first.wait_for()
    first_row = page.locator(".row-line[data-pick]").first
    first_row.get_by_role("checkbox").click()  # it changes with the document
    second.locator(".row-line[data-pick].disabled").first.wait_for()
    first_row.get_by_role("checkbox").click()
    other.close()

    operator.step("Solve")
    page.get_by_role("button", name="Run: Simplex", exact=True).click()
    operator.wait(lambda: (operator.slice("job") or {}).get("kind") == "simplex", "the simplex begins")
    # At its first speed it ends after some seconds, on a busy computer between two clicks.
    assert operator.socket.ask("job_control", action="speed", value=2)["ok"]
    page.get_by_role("button", name="Pause").first.click()
    operator.wait(lambda: operator.slice("job")["state"] == "paused", "a pause")
    page.get_by_role("button", name="Resume").first.wait_for()
    paused_at = operator.slice("job")["done"]
    operator.shot("simplex-paused")
    page.get_by_role("button", name="Resume").first.click()
    # the iteration that was under way at the pause is counted after it
    operator.wait(lambda: operator.slice("job")["done"] > paused_at + 1, "it resumes")
    page.get_by_role("button", name="Pause").first.click()
    operator.wait(lambda: operator.slice("job")["state"] == "paused", "another pause")
    page.get_by_role("button", name="Keep best").first.click()
    operator.wait(lambda: operator.slice("job")["state"] == "stopped", "it stops")
    stages = operator.wait(
        lambda: [s for s in operator.slice("poses:p1")["stages"] if s["stage"] == "simplex"], "the best pose is kept"
    )
    assert len(stages[0]["parameters"]) == 6

    operator.wait(lambda: operator.slice("judged:p1")["stage"] == "simplex", "its residuals")
    operator.step("Judge")
    canvas = page.get_by_role("slider", name="Threshold of the depth errors")
    canvas.wait_for()
    box = canvas.bounding_box()
    assert box is not None
    before = float(canvas.get_attribute("aria-valuenow") or 0)
    most = float(canvas.get_attribute("aria-valuemax") or 1)
    em = 12.0
    y = box["y"] + em * 0.8 + (1 - (before / most + 1) / 2) * (box["height"] - 1.6 * em)
    page.mouse.move(box["x"] + box["width"] - 6, y)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] - 6, (y + box["y"] + box["height"] / 2) / 2, steps=6)
    page.mouse.up()
    after = float(canvas.get_attribute("aria-valuenow") or 0)
    assert 0 < after < before
    operator.shot("threshold")
    page.get_by_role("button", name=re.compile(r"^(Disable|Re-enable) \d")).click()

    def rejected() -> bool:
        judged = operator.slice("judged:p1")["by_pick"]
        errors = {name: said["depth_m"] for name, said in judged.items() if said["depth_m"] is not None}
        picks = [pick for pick in operator.slice("picks:p1") if pick["id"] in errors]
        near = 1e-3 * after  # the page shows three digits
        return bool(picks) and all(
            pick["on"] == (abs(errors[pick["id"]]) <= after)
            for pick in picks
            if abs(abs(errors[pick["id"]]) - after) > near
        )

    operator.wait(rejected, "matches above the threshold are disabled, those below enabled")
    page.keyboard.press("Control+z")

    page.get_by_role("button", name="Automatic", exact=False).first.wait_for()
    operator.socket.ask("use_stage", photo="p1", stage="auto")
    page.get_by_label("Texture of the model").select_option("range")
    page.wait_for_function("document.querySelector('[aria-label=\"Texture of the model\"]').value === 'range'")
    page.get_by_label("Texture of the model").select_option("colour")
    operator.shot("judged")

    operator.step("Export")
    with page.expect_download(timeout=120_000) as download:
        operator.button("Download zip").click()
    target = tmp_path / "result.zip"
    download.value.save_as(target)
    with zipfile.ZipFile(target) as file:
        assert file.testzip() is None
        assert {"registration.json", "model.glb", "cloud.ply", "matches.json"} <= set(file.namelist())
        assert json.loads(file.read("registration.json"))["accepted"]
    operator.shot("exported")


@pytest.mark.slow
def test_the_report_opens_in_a_tab_of_its_own(
    browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest
) -> None:
    """Its policy lets in nothing but its own styles and pictures, and these suffice."""
    workbench.open("solved")
    with at_work(browser, workbench.server, request) as operator:
        operator.open()
        check_the_report(operator)


def check_the_report(operator: Operator) -> None:
    page = operator.page
    operator.step("Export")
    operator.button("Write report").click()
    with page.expect_popup() as opened:
        page.get_by_role("link", name="Open the report").click(timeout=120_000)
    report = opened.value
    report.get_by_role("heading", name="The worst matches, enlarged").wait_for()
    report.wait_for_load_state()  # its pictures come after it in the file
    sizes = report.evaluate("[...document.images].map((image) => image.naturalWidth)")
    assert len(sizes) >= 8
    assert min(sizes) > 0, "the policy lets every embedded picture in"
    report.close()


@pytest.mark.slow
def test_a_line_can_be_drawn_without_a_mouse(operator: Operator) -> None:
    page = operator.page
    before = len(operator.slice("picks:p1"))
    page.keyboard.press("n")
    for side in ("scan", "photo"):
        body = page.locator(f"#{side}-pane [role=application], #{side}-pane .pane-body[tabindex]").first
        body.focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Enter")
        for _ in range(4):
            page.keyboard.press("Shift+ArrowRight")
        page.keyboard.press("Enter")
    picks = operator.wait(
        lambda: p if len(p := operator.slice("picks:p1")) == before + 1 else None, "a line drawn by keys"
    )
    assert abs(picks[-1]["photo"][0][0] - picks[-1]["photo"][1][0]) == pytest.approx(40, abs=0.2)


@pytest.mark.slow
def test_the_policy_lets_the_page_work(browser: Browser, workbench: SharedWorkbench) -> None:
    """Without the driver's bypass: no violation, and the workbench connects."""
    workbench.look_at("camera")
    server = workbench.server
    page = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
    violations: list[str] = []
    page.on("console", lambda m: violations.append(m.text) if "Content Security Policy" in m.text else None)
    page.goto(f"{server.address}?token={server.token}")
    page.get_by_role("button", name="connected").wait_for()
    assert "token" not in page.url
    page.locator("#photo-pane canvas").first.wait_for(state="attached")
    page.locator("#model-pane [data-model=drawn]").wait_for(timeout=90_000)
    two_frames(page)
    page.close()
    assert not violations


@pytest.mark.slow
def test_a_bad_file_is_reported_in_the_dialog(
    browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    workbench.open("camera")
    with at_work(browser, workbench.server, request, expected="400 (Bad Request)") as operator:
        operator.open()
        give_a_bad_file(operator, tmp_path)


def give_a_bad_file(operator: Operator, tmp_path: Path) -> None:
    page = operator.page
    whole = next(sample_folder().glob("photo.*")).read_bytes()
    cut = tmp_path / "cut.png"
    cut.write_bytes(whole[: len(whole) // 3])
    photos = len(operator.slice("photos"))
    page.locator(".scan-chip").click()
    dialog = page.locator("dialog[open]")
    dialog.locator("input[type=file]").first.set_input_files(str(cut))
    dialog.get_by_text("cut.png", exact=False).first.wait_for()
    operator.wait(lambda: WRONG.search(dialog.inner_text()), "the error is shown")
    operator.shot("bad-file")
    assert len(operator.slice("photos")) == photos
    page.keyboard.press("Escape")


@pytest.mark.slow
def test_it_fits_small_and_large_screens(onlooker: Operator) -> None:
    page = onlooker.page
    for scheme, size in itertools.product(("dark", "light"), ((1366, 768), (3840, 2160))):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        page.set_viewport_size({"width": size[0], "height": size[1]})
        two_frames(page)
        onlooker.shot(f"{scheme}-{size[0]}")
        overflow = page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
        assert overflow[0] <= size[0]
        assert overflow[1] <= size[1]
        for name in ("scan", "photo", "model"):
            box = page.locator(f"#{name}-pane").bounding_box()
            assert box is not None
            assert box["width"] > 0.2 * size[0]
        assert page.get_by_role("button", name="Register automatically").is_visible()


@pytest.mark.slow
def test_everything_can_be_read(onlooker: Operator) -> None:
    """Contrast of text at least 4.5:1, of icons and meaningful edges 3:1, in all steps, panels and dialogs."""
    page = onlooker.page
    page.evaluate(
        "import('./js/ui/notices.js').then((m) => ['info', 'warn', 'bad'].forEach((l) => m.notice(`${l}.`, l)))"
    )
    faults: dict[str, str] = {}

    def look(where: str) -> None:
        for scheme in ("dark", "light"):
            page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            faults.update(dict.fromkeys(hard_to_read(page), f"{where}, {scheme}"))

    for step in ("Match", "Solve", "Judge", "Export"):
        page.get_by_role("tab", name=step, exact=True).click()
        look(step)
    panels = (".history-button", ".clients-button", ".camera-button", "#scan-pane .pane-opener", ".scan-chip")
    for opener in (*panels, "[aria-label='Keyboard reference (?)']"):
        page.locator(opener).click()
        page.wait_for_selector(OPEN)
        look(opener)
        page.keyboard.press("Escape")
    assert not faults, "\n".join(f"{where}: {fault}" for fault, where in faults.items())


@pytest.mark.slow
def test_everything_is_reached_by_keyboard(onlooker: Operator) -> None:
    """Each control shows its focus; Escape closes what was opened and returns the focus."""
    page = onlooker.page
    unseen, missed = lost_without_a_mouse(page)
    assert not unseen
    assert not missed
    for opener in (".scan-chip", ".history-button", ".camera-button", "[aria-label='Keyboard reference (?)']"):
        page.locator(opener).focus()
        page.keyboard.press("Enter")
        page.wait_for_selector(OPEN)
        page.keyboard.press("Escape")
        page.wait_for_selector(OPEN, state="detached")
        assert page.locator(opener).evaluate("(opener) => document.activeElement === opener")


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="no kill -9 to send")
def test_a_killed_server_loses_nothing(browser: Browser, tmp_path: Path) -> None:
    project = tmp_path / "project"
    with served(project) as (found, _):
        socket = Socket(found)
        for k in range(3):
            assert socket.ask("add_pick", photo="p1", kind="point", scan=[[1, k / 20, 0]], photo_uv=[[100 + k, 50]])[
                "ok"
            ]
        assert socket.ask("undo")["ok"]
        os.kill(found.process.pid, signal.SIGKILL)
        found.process.wait(30)
    with served(project) as (again, _):
        context = browser.new_context(viewport=SIZE, bypass_csp=True)  # type: ignore[arg-type]
        page = context.new_page()
        without_model(page)
        page.goto(f"{again.address}?token={again.token}")
        page.locator(".row-line[data-pick]").nth(1).wait_for()
        assert page.locator(".row-line[data-pick]").count() == 2
        page.keyboard.press("Control+Shift+z")
        page.locator(".row-line[data-pick]").nth(2).wait_for()
        context.close()


@pytest.mark.slow
def test_a_lost_connection_comes_back_with_the_present_state(
    browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest
) -> None:
    workbench.open("camera")
    lines: list[WebSocketRoute] = []
    added: list[str] = []
    with at_work(browser, workbench.server, request, expected="ERR_INTERNET_DISCONNECTED") as operator:
        page = operator.page

        def connect(line: WebSocketRoute) -> None:
            if lines:  # something happens while the page is away
                reply = operator.socket.ask(
                    "add_pick", photo="p1", kind="point", scan=[[1, 0.01, 0]], photo_uv=[[333, 222]]
                )
                added.append(reply["pick"])
            lines.append(line)
            line.connect_to_server()

        page.route_web_socket(re.compile("/document"), connect)
        operator.open()
        page.context.set_offline(True)
        page.evaluate("window.dispatchEvent(new Event('offline'))")
        lines[0].close()
        page.get_by_role("button", name="connected", exact=True).wait_for(state="hidden")
        page.context.set_offline(False)
        page.get_by_role("button", name="connected", exact=True).wait_for()
        assert len(added) == 1
        number = next(pick["number"] for pick in operator.slice("picks:p1") if pick["id"] == added[0])
        wait_for_store(page, f"store.picksOf().some((pick) => pick.number === {number})")
