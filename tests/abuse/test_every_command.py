"""Every command of a page, with arguments that are extreme, hostile or of another type.

A command is refused in one plain sentence and changes nothing, or what it did is found by a fresh reader of the
project's folder, document and history.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.gateway.encoding import InvalidMessageError, decode_object, encode
from ladarreg.workbench.commands.registry import COMMANDS

from ladarreg_core.formats import read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.project.history import History
from ladarreg_core.project.settings import Settings
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench

DEEP = "[" * 900 + "]" * 900
NUMBERS = (
    "0", "-0.0", "-1", "1", "2.5", "5e-324", "1e-308", "1e308", "-1e308", "1.7976931348623157e308", "1e400", "NaN",
    "1" + "0" * 400, "-1" + "0" * 400, "1" + "0" * 5000, "9007199254740993", "2147483648",
)  # fmt: skip
WORDS = (
    '""', '" "', '"\\u0000"', '"a\\u0000b"', '"\\ud800"', '"\\u202e\\u2028"', '"../../x"', '"/"', '"\\\\\\\\x\\\\y"',
    '"' + "a" * 300 + '"', '"' + "a/" * 3000 + '"', '"' + "ä" * 100_000 + '"',
    '"p1"', '"1"', '"new"', '"id"', '"linear"',
)  # fmt: skip
OTHERS = (
    "null", "true", "false", "{}", "[]", "[[]]", DEEP, '{"a": ' * 300 + "1" + "}" * 300, "[" + "1," * 50_000 + "1]",
)  # fmt: skip
ROWS = (
    "[[1e308, 1e308, 1e308]]", "[[1e308, 1e308]]", "[[-1e308, 1e308, 0], [1, 0, 0]]", "[[5e-324, 5e-324, 0]]",
    "[[5e-324, 0], [0, 5e-324]]", "[[0, 0, 0]]", "[[0, 0]]", "[[1, 0, 0], [-1, 0, 0]]", "[[1, 0, 0], [1, 0, 0]]",
    "[[3, 4], [3, 4]]", "[[1e6, -1e6]]", "[[1000001, 0]]", "[[-1, 0, 0]]", "[[0, 0, 1]]", "[[0, 0, -1], [0, 1, 0]]",
    "[[1, 2, 3, 4]]", "[[1, 2, 3], [1, 2]]", "[[true, 0, 0]]", "[[1, null, 0]]", "[[\"1\", 0, 0]]",
    "[[1" + "0" * 400 + ", 0, 0]]", "[[1, 1" + "0" * 400 + "]]", "[" + "[1, 0, 0]," * 20_000 + "[1, 0, 0]]",
    "[1, 0, 0]", "[1e308, 1e308, 1e308]", "[1e308, 1e308]", "[0, 0, 0]", "[-5, 1e5]",
)  # fmt: skip
LISTS = ('["1"]', '["1", "1", "nobody"]', '["nobody"]', "[1]", json.dumps([str(k) for k in range(100_000)]))
HOSTILE = (*NUMBERS, *WORDS, *OTHERS, *ROWS, *LISTS)
BAD_FOLDERS = tuple(json.dumps(name) for name in ("\0", "a\0b", "a" * 300, "a/" * 3000, "\u202e\u2028", "\ud800"))
FEW = {
    ("open_served", "photo"): OTHERS[:3],
    ("open_served", "scan"): (*OTHERS[:3], '"frames"', '"stations"'),
    ("refine", "photo"): OTHERS,
    ("export", "photos"): (*OTHERS, *WORDS, *LISTS),
    ("export", "folder"): BAD_FOLDERS,
    **dict.fromkeys((("export", name) for name in ("force", "full", "last_solved")), OTHERS[:2]),
    **dict.fromkeys(
        (("set_settings", name) for name in Settings.__struct_fields__), (*NUMBERS, *OTHERS[:6], *WORDS[:6])
    ),
}
"""Limits by command and argument, for long lists and expensive commands."""

LINE = {"scan": [[1, 0.05, 0.0], [1, 0.1, 0.02]], "photo_uv": [[300.25, 200.5], [410.125, 220]]}
PLAN = {
    "version": 1, "unit": {"port": "COM251"}, "scanner": {"kind": "scip2", "port": "COM252"}, "mode": "sweep",
    "pan_deg": [-10, 10, 1], "tilt_deg": [0, 0, 0], "mount": {"xyz_m": [0, 0, 0], "rpy_deg": [90, 0, 0]},
}  # fmt: skip
SOUND: dict[str, list[dict[str, Any]]] = {
    "register_stations": [{}, {"poses": "keep"}],
    "check_at_stations": [{}],
    "place_station": [
        {"station": "s1", "place": {"x": 1, "y": 2, "z": 0, "yaw_deg": 90}},
        {"station": "s1", "place": None},
    ],
    "place_camera": [
        {"photo": "p1", "start": "scanner", "shift_m": [0.1, 0.0, -0.1], "turn_deg": [1, 0, 2]},
        {"photo": "p1", "camera_from_scanner": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        {"photo": "p1"},
    ],
    "show_station": [{"station": "s1"}],
    "set_station": [{"photo": "p1", "station": "s1"}, {"photo": "p1"}],
    "remove_station": [{"station": "s1"}],
    "acquire_ports": [{}],
    "acquire_check": [{"plan": PLAN}],
    "acquire_keep": [{"plan": PLAN}, {"plan": {"half": "a plan"}}],
    "acquire_connect": [{"plan": PLAN}],
    "acquire_disconnect": [{}],
    "acquire_jog": [{"pan_deg": 1, "tilt_deg": 0}],
    "acquire_start": [{"plan": PLAN, "resume": "run-001"}],
    "acquire_pause": [{}],
    "acquire_resume": [{}],
    "acquire_stop": [{}],
    "acquire_take_over": [{}],
    "acquire_open": [{"run": "run-001"}],
    "acquire_photos": [{"run": "run-001"}],
    "add_pick": [
        {"photo": "p1", "kind": "line", **LINE},
        {"photo": "p1", "kind": "point", "scan": [[1, 0, 0]], "photo_uv": [[300.25, 200.5]]},
    ],
    "set_pick": [
        {"photo": "p1", "pick": "2", "on": False, "weight": 2.5},
        {"photo": "p1", "pick": "1", "scan": [[1, 0.01, 0]], "photo_uv": [[300, 200]]},
    ],
    "measure": [{"kind": "point", "places": [{"ray": [1, 0, 0]}]}],
    "add_measurement": [{"kind": "distance", "places": [{"ray": [1, 0.1, 0]}, {"ray": [1, -0.1, 0]}]}],
    "rename_measurement": [{"measurement": "m1", "name": "Beam"}],
    "remove_measurements": [{"measurements": ["m1"]}],
    "preview_smoothing": [{"photo": "p1", "show": "after"}],
    "discard_smoothing": [{}],
    "apply_smoothing": [{"photo": "p1", "rev": "0123456789abcdef", "edges": True}],
    "restore_ranges": [{}],
    "remove_picks": [{"photo": "p1", "picks": ["3"]}],
    "switch_picks": [{"photo": "p1", "picks": ["1", "2"], "on": False}],
    "reject": [{"photo": "p1", "by": "px", "above": 2.0}, {"photo": "p1", "by": "depth", "above": 0.05}],
    "set_camera": [
        {"photo": "p2", "focal_px": 700.0},
        {"photo": "p2", "focal_mm": 35, "sensor_mm": 36},
        {"photo": "p2", "focal_35mm": 26},
    ],
    "set_settings": [
        {
            "t1": 0.25, "corners": 400, "window_px": 17, "t2_px": 25, "search_px": 12, "constrained_t1": 0.2,
            "mutual": True,
            "depth_edges": "foreground", "culling": "two_sided", "lines": "equal", "samples_per_line": 11,
        },
        {
            "residual": "stereo", "start_from": "robust", "step_m": 0.1, "step_rad": 0.2, "restarts": 1,
            "reject_sigma": 3, "intrinsics": "fixed", "sigma_px": 0.7, "sigma_range_m": None, "match_tolerance_m": 0.2,
            "seed": 7,
            "solve_automatically": False, "solve_up_to": 50, "centre_sigma_percent": 1.0, "k1_sigma": 0.02,
        },
    ],
    "rename": [{"name": "Office 7"}],
    "remove_photo": [{"photo": "p3"}],
    "use_stage": [{"photo": "p1", "stage": "linear"}],
    "undo": [{}],
    "redo": [{}],
    "go_to": [{"n": 3}],
    "show_photo": [{"photo": "p1"}],
    "set_model": [{"texture": "range", "z_buffer": False, "detail": "coarse", "cameras": False, "rays": True}],
    "call_me": [{"name": "Ann"}],
    "hover_pick": [{"pick": "1"}],
    "open_served": [
        {"path": "matches.csv", "what": "matches", "photo": "p1"},
        {"paths": ["scan.npz"], "what": "scan", "scan": "replace"},
    ],
    "list_served": [{}],
    "open_files": [{"files": ["nobody"], "scan": "replace", "photo": "p1"}],
    "discard_files": [{"files": ["nobody"]}],
    "add_embedded": [{"images": [0]}],
    "look": [{"viewpoint": "scanner"}],
    "follow": [{"client": None}],
    "point": [{"side": "photo", "photo": "p1", "view": 0, "uv": [300, 200]}],
    "show_view": [{"side": "photo", "photo": "p1", "view": 0, "centre": [300, 200], "zoom": 2.0}],
    "read_only_link": [{}],
    "predict": [
        {"photo": "p1", "side": "scan", "scan": [[1, 0, 0]]},
        {"photo": "p1", "side": "photo", "photo_uv": [[300, 200]]},
    ],
    "where": [{"photo": "p1", "scan": [1, 0, 0]}],
    "snap": [
        {"photo": "p1", "side": "photo", "ends": [[300, 200]]},
        {"side": "scan", "view": 0, "ends": [[200, 150], [260, 170]], "px_per_screen": 1.5},
    ],
    "sample_line": [{"scan": LINE["scan"]}],
    "probe": [{"scan": [1, 0, 0]}],
    "run": [{"photo": "p1", "job": "linear"}],
    "register_all": [{"photos": []}],
    "adjust": [{"photos": ["p99"]}],
    "set_part": [
        {"photos": ["p1"], "part": "out"},
        {"photos": ["p99"], "part": "free"},
        {"photos": [], "part": "held"},
    ],
    "add_tie": [
        {"photos": ["p1", "p2"], "uv": [[300.0, 200.5], [310, 210]], "sigma_px": 0.5},
        {"photos": ["p1", "p2"], "uv": [[120, 80], [130, 90]]},
    ],
    "remove_ties": [{"ties": ["t1"]}],
    "draw_line": [
        {"photo": "p1", "uv": [[300.0, 200.5], [310, 290]], "sigma_px": 0.5},
        {"photo": "p2", "uv": [[120, 80], [130, 190]], "line": "l1"},
    ],
    "draw_line_in_scan": [
        {"scan": LINE["scan"], "line": "l1", "sigma_rad": 0.001},
        {"scan": LINE["scan"], "station": "s9"},
    ],
    "scan_of": [{}, {"station": "s9"}],
    "erase_line": [{"line": "l1"}, {"line": "l1", "photo": "p2"}],
    "line_ends_as_ties": [{"line": "l1"}],
    "remove_lines": [{"lines": ["l1"]}],
    "hold_camera": [{"camera": "camera-1", "held": True}],
    "refine": [{"photo": "p1", "camera_from_scanner": [[1, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}],
    "job_control": [{"action": "speed", "value": 3}],
    "export_targets": [
        {
            "targets": ["results"], "photos": ["p1"], "frame": "scanner", "full": True, "crop": "photo",
            "last_solved": True,
        }
    ],
    "write_report": [{"photo": "p3"}],
    "export": [
        {
            "targets": ["opencv"], "photos": ["p1"], "frame": "scanner", "full": False, "crop": "none",
            "last_solved": True, "folder": "FOLDER", "force": False,
        }
    ],
}  # fmt: skip
"""Arguments of each command; each is replaced by hostile ones, one at a time."""


class Page:
    """A page that sends arbitrary text, and a second reader that opens the project after every change."""

    def __init__(self, bench: WorkbenchDriver, aside: Path) -> None:
        self.bench, self._aside = bench, aside
        self._read: History | None = None

    def ask(self, text: str) -> dict[str, Any] | None:
        """Send a text like the websocket; return the reply, or None if the text is not JSON."""
        try:
            message = decode_object(text)
        except InvalidMessageError:
            return None
        reply = self.bench.workbench.answer(self.bench.client, message)
        self.bench.workbench.runner.wait(60)
        return json.loads(encode(reply), parse_constant=pytest.fail)  # type: ignore[no-any-return]

    def try_it(self, text: str) -> bool:
        """Send a text, check the reply and the files; return whether the command succeeded."""
        before = self.bench.workbench.session.history
        reply = self.ask(text)
        history = self.bench.workbench.session.history
        done = reply is not None and reply["ok"]
        if reply is not None and not done:
            sentence = reply["error"]
            assert sentence.endswith((".", "!", "?")), sentence
            assert len(sentence) < 700
            assert sentence.isprintable()
            assert "Internal error" not in sentence, (text[:200], sentence)
        if not done:
            assert history is before, text[:200]
        elif history is not before:
            self.check_the_folder()
        return done

    def check_the_folder(self) -> None:
        """Open a copy of the project as another program would, and compare."""
        session = self.bench.workbench.session
        shutil.rmtree(self._aside, ignore_errors=True)
        # What another thread is just writing goes by a name of its own, which may be gone when it is copied.
        passing = shutil.ignore_patterns("inputs", "lock", "*.part")
        shutil.copytree(session.folder.path, self._aside, ignore=passing)
        folder = ProjectFolder(self._aside)
        try:
            found = folder.read()
        finally:
            folder.close()
        kept = session.history
        assert found.at == kept.at
        assert [(e.number, e.label, e.author, e.when) for e in found.entries] == [
            (e.number, e.label, e.author, e.when) for e in kept.entries
        ]
        assert all(a.document == b.document for a, b in zip(found.entries, kept.entries, strict=True))


@pytest.fixture(scope="session")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A workbench with matches, a pose, a served folder and three photographs."""
    home, sample = tmp_path_factory.mktemp("commands"), sample_folder()
    served = home / "served"
    served.mkdir()
    shutil.copy(sample / "scan.npz", served / "scan.npz")
    (served / "matches.csv").write_text("x,y,z,u,v\n1,0.01,0,310,200\n")
    bench = sample_bench(home / "project", folder=served)
    for name in ("second.png", "third.png"):
        path = bench.workbench.upload_folder() / name
        shutil.copy(sample / "photo.png", path)
        bench.workbench.take_upload(path, name, "photo", None, bench.client)
    pose, camera, scan = (
        read_pose(sample / "truth.json"), read_camera(sample / "camera.json"), read_scan(sample / "scan.npz"),
    )  # fmt: skip
    points = scan.points[20::60, 20::60].reshape(-1, 3).astype(float)
    points = points[np.isfinite(points).all(axis=1)]
    uv = camera.project(pose @ points)
    seen = np.flatnonzero(camera.contains(uv))
    for k in seen[:: max(1, len(seen) // 24)].tolist():
        point, at = points[k].tolist(), uv[k].tolist()
        bench.do("add_pick", photo="p1", kind="point", scan=[point], photo_uv=[at])
    job = bench.job("linear")
    assert job.state == "done", job.message
    yield Page(bench, home / "aside")
    bench.workbench.close()


def message(do: str, fields: dict[str, str]) -> str:
    """Return the text of a message whose fields are JSON already."""
    return json.dumps({"id": 1, "do": do})[:-1] + "".join(f", {json.dumps(k)}: {v}" for k, v in fields.items()) + "}"


def as_json(fields: dict[str, Any], folder: Path) -> dict[str, str]:
    return {name: json.dumps(str(folder) if value == "FOLDER" else value) for name, value in fields.items()}


def test_the_sweep_knows_every_command() -> None:
    assert set(SOUND) == set(COMMANDS)


@pytest.mark.slow
@pytest.mark.parametrize("do", sorted(SOUND))
@pytest.mark.parametrize("share", [5, pytest.param(1, marks=pytest.mark.long)], ids=["some", "all"])
def test_a_command_is_refused_or_saved(page: Page, tmp_path: Path, do: str, share: int) -> None:
    """With every fifth hostile value, another fifth for every argument; or with all of them."""
    page.bench.do("go_to", n=max(entry["n"] for entry in page.bench.slice("history")["entries"]))
    last = page.bench.workbench.session.history.present.number
    for sound in SOUND[do]:
        fields = as_json(sound, tmp_path / "results")
        page.try_it(message(do, fields))
        for k, name in enumerate(fields):
            values = FEW.get((do, name), HOSTILE)
            for hostile in values[(k + len(do)) % min(share, len(values)) :: share]:
                if name == "folder":
                    hostile = json.dumps(f"{tmp_path}/out/")[:-1] + hostile[1:]
                page.try_it(message(do, {**fields, name: hostile}))
            page.try_it(message(do, {k: v for k, v in fields.items() if k != name}))
    page.try_it(message(do, dict.fromkeys(["photo", "pick", "picks", "n", "at", "scan", "name", "path"], DEEP)))
    page.bench.workbench._slow_slices()  # whatever was accepted can be assessed
    page.bench.do("go_to", n=last)
    assert page.bench.slice("scan")["views"]


@pytest.mark.parametrize("hostile", [*OTHERS, *NUMBERS, *WORDS])
def test_a_message_of_any_kind_is_answered(page: Page, hostile: str) -> None:
    for text in (
        hostile,
        f'{{"id": {hostile}, "do": "undo"}}',
        f'{{"id": 1, "do": {hostile}}}',
        f'{{"id": 1, "do": "rename", "name": "x", {json.dumps("a" * 1000)}: {hostile}}}',
    ):
        page.try_it(text)
