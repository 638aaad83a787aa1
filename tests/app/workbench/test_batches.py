"""Files dropped together: what belongs together is found by content, in any order and under any name."""

from __future__ import annotations

import itertools
import json
import random
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ladarreg.workbench.files.batch_plan import BatchFile, PhotoTarget, Plan, plan_batch

from ladarreg_core.formats.survey import FileSurvey
from ladarreg_core.simulate.sample import sample_folder
from testing.files.small_scans import make_scan
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench

PHOTO = next(sample_folder().glob("photo.*"))
CAMERA = json.loads((sample_folder() / "camera.json").read_text())


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    """An empty project."""
    found = open_bench(tmp_path / "project")
    yield found
    found.workbench.close()


def upload(bench: WorkbenchDriver, name: str, data: bytes) -> str:
    """Upload a file whose content decides its kind, and return its id."""
    path = bench.workbench.upload_folder() / f"{random.getrandbits(128):032x}{Path(name).suffix}"
    path.write_bytes(data)
    return bench.workbench.take_upload(path, name, "any", None, bench.client)


def drop(bench: WorkbenchDriver, files: dict[str, bytes], **choice: Any) -> dict[str, Any]:
    """Upload files and open them together."""
    return bench.do("open_files", files=[upload(bench, name, data) for name, data in files.items()], **choice)


def waiting(bench: WorkbenchDriver) -> dict[str, str]:
    """Return why files wait, by name."""
    return {file["name"]: file["said"] for file in bench.slice("waiting")}


def kinds(reply: dict[str, Any]) -> list[str]:
    return [opened["kind"] for opened in reply["opened"]]


def depth_scan() -> dict[str, bytes]:
    """A scan of three files: a descriptor, its depth image and its intensity."""
    rows, columns = 60, 80
    depth = np.full((rows, columns), 2000, np.uint16)
    depth[20:40, 30:50] = 1500
    intensity = (np.indices((rows, columns)).sum(axis=0) % 9 * 25).astype(np.uint8)
    camera = {"width": columns, "height": rows, "fx": 70.0, "fy": 70.0, "cx": 39.5, "cy": 29.5}
    fields = {"kind": "depth-image", "depth": "depth.png", "intensity": "images/intensity.png", "depth_unit_m": 0.001,
              "depth_is": "z", "camera": camera}  # fmt: skip
    png = {name: cv2.imencode(".png", image)[1].tobytes() for name, image in (("d", depth), ("i", intensity))}
    return {"kinect.json": json.dumps(fields).encode(), "depth.png": png["d"], "intensity.png": png["i"]}


def matches_of_points() -> bytes:
    return b"row,column,u,v\n10,10,5,5\n10,60,400,20\n50,60,420,300\n50,10,20,310\n"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_whole_batch_is_opened_in_any_order(bench: WorkbenchDriver, seed: int) -> None:
    """Scan of three files, photograph, camera and matches, with extensions that say nothing or the wrong thing."""
    descriptor, depth, intensity = depth_scan().items()
    files = dict(
        [
            (descriptor[0].replace(".json", ".txt"), descriptor[1]),
            depth,
            ("Intensity.PNG", intensity[1]),
            ("photo.npz", PHOTO.read_bytes()),
            ("calibration.png", json.dumps(CAMERA).encode()),
            ("list.dat", matches_of_points()),
        ]
    )
    shuffled = list(files.items())
    random.Random(seed).shuffle(shuffled)
    reply = drop(bench, dict(shuffled))
    assert kinds(reply) == ["scan", "photo", "camera", "matches"], reply
    assert (reply["waiting"], reply["refused"], bench.slice("waiting")) == ([], [], [])
    assert bench.slice("scan")["returns"] == 4800
    photo = bench.slice("photos")[0]
    assert photo["camera"]["fx"] == pytest.approx(CAMERA["fx"])
    assert len(bench.slice("picks:p1")) == 4


def test_the_project_opens_again_with_a_scan_of_several_files(tmp_path: Path) -> None:
    bench = open_bench(tmp_path / "project")
    drop(bench, depth_scan())
    bench.workbench.close()
    shutil.move(tmp_path / "project", tmp_path / "moved")
    bench = open_bench(tmp_path / "moved")
    assert bench.slice("scan")["returns"] == 4800
    bench.workbench.close()


def test_a_descriptor_waits_for_its_images_even_over_a_restart(tmp_path: Path) -> None:
    files = depth_scan()
    bench = open_bench(tmp_path / "project")
    reply = drop(bench, {"kinect.json": files["kinect.json"], "intensity.png": files["intensity.png"]})
    assert reply["opened"] == []
    said = "the descriptor names depth.png, which was not among the files: drop it as well"
    assert waiting(bench)["kinect.json"] == said
    assert bench.slice("photos") == [], "the intensity image is not a photograph"
    bench.workbench.close()

    bench = open_bench(tmp_path / "project")
    assert set(waiting(bench)) == {"kinect.json", "intensity.png"}
    late = upload(bench, "depth.png", files["depth.png"])
    again = [file["id"] for file in bench.slice("waiting") if file["kind"] == "scan"]
    assert kinds(bench.do("open_files", files=[late, *again])) == ["scan"]
    assert bench.slice("waiting") == []
    bench.workbench.close()


def test_the_missing_image_completes_what_waits(bench: WorkbenchDriver) -> None:
    files = depth_scan()
    drop(bench, {"kinect.json": files["kinect.json"]})
    assert "names depth.png and images/intensity.png" in waiting(bench)["kinect.json"]
    drop(bench, {"photo.jpg": PHOTO.read_bytes()})
    assert set(waiting(bench)) == {"kinect.json"}
    assert kinds(drop(bench, {name: files[name] for name in ("intensity.png", "depth.png")})) == ["scan"]
    assert len(bench.slice("photos")) == 1


@pytest.mark.slow
def test_a_second_scan_is_a_question(bench: WorkbenchDriver) -> None:
    scan = (sample_folder() / "scan.npz").read_bytes()
    assert kinds(drop(bench, {"first.npz": scan})) == ["scan"]
    reply = drop(bench, {"second.npz": scan, "photo.jpg": PHOTO.read_bytes()})
    assert (reply["asks"], reply["opened"]) == ("scan", [])
    assert bench.slice("scan")["name"] == "first.npz"
    assert set(waiting(bench)) == {"second.npz", "photo.jpg"}, "nothing is lost"
    reply = bench.do("open_files", files=reply["waiting"], scan="replace")
    assert kinds(reply) == ["scan", "photo"]
    assert bench.slice("scan")["name"] == "second.npz"


def test_two_scans_are_a_question(bench: WorkbenchDriver) -> None:
    scan = (sample_folder() / "scan.npz").read_bytes()
    reply = drop(bench, {"a.npz": scan, "b.npz": scan, "photo.jpg": PHOTO.read_bytes()})
    assert (reply["asks"], reply["scans"], reply["opened"]) == ("scan", ["a.npz", "b.npz"], [])
    assert waiting(bench)["b.npz"] == "one of 2 scans, a.npz and b.npz: open them together, or this one alone"
    assert waiting(bench)["photo.jpg"] == "it is opened as soon as you choose what becomes of a.npz and b.npz"
    chosen = [file["id"] for file in bench.slice("waiting") if file["name"] != "a.npz"]
    assert kinds(bench.do("open_files", files=chosen)) == ["scan", "photo"]
    assert set(waiting(bench)) == {"a.npz"}
    bench.do("discard_files", files=[file["id"] for file in bench.slice("waiting")])
    assert bench.slice("waiting") == []
    assert sum(path.is_file() for path in bench.workbench.upload_folder().rglob("*")) == 2


@pytest.mark.slow
def test_descriptors_are_frames_as_well_and_wait_whole_if_they_are_refused(bench: WorkbenchDriver) -> None:
    parts = depth_scan()
    drop(bench, parts)
    far = np.full((60, 80), 9000, np.uint16)
    moved = {**parts, "depth.png": cv2.imencode(".png", far)[1].tobytes()}
    ids = drop(bench, moved)["waiting"]
    reply = bench.do("open_files", files=ids, scan="frames")
    assert "kinect.json was not taken from where kinect.json was" in reply["said"]
    assert set(waiting(bench)) == set(parts)
    bench.do("discard_files", files=ids)
    nearly = {**parts, "intensity.png": cv2.imencode(".png", np.full((60, 80), 90, np.uint8))[1].tobytes()}
    ids = drop(bench, nearly)["waiting"]
    assert kinds(bench.do("open_files", files=ids, scan="frames")) == ["frame"]
    assert bench.slice("scan")["files"] == ["kinect.json", "kinect.json"]
    assert bench.slice("waiting") == []


def test_a_camera_waits_for_its_photograph(bench: WorkbenchDriver) -> None:
    drop(bench, {"camera.json": json.dumps(CAMERA).encode()})
    assert waiting(bench) == {"camera.json": "a camera belongs to a photograph: drop the photograph as well"}
    assert kinds(drop(bench, {"photo.jpg": PHOTO.read_bytes()})) == ["photo", "camera"]
    assert bench.slice("photos")[0]["camera"]["calibrated"]


@pytest.mark.slow
def test_matches_are_chosen_for_a_photograph(bench: WorkbenchDriver) -> None:
    scan, photo = (sample_folder() / "scan.npz").read_bytes(), PHOTO.read_bytes()
    drop(bench, {"scan.npz": scan, "left.jpg": photo, "right.jpg": photo, "list.csv": matches_of_points()})
    assert waiting(bench) == {"list.csv": "it could belong to left.jpg or right.jpg: choose the photograph"}
    ids = [file["id"] for file in bench.slice("waiting")]
    assert bench.do("open_files", files=ids, photo="p2")["opened"][0]["photo"] == "p2"
    assert len(bench.slice("picks:p2")) == 4
    assert bench.slice("picks:p1") == []


def test_what_cannot_be_read_is_refused_with_its_name(bench: WorkbenchDriver) -> None:
    reply = drop(bench, {"cut.png": PHOTO.read_bytes()[:3000]})
    assert reply["opened"] == []
    assert reply["refused"][0]["error"].startswith("cut.png: ")
    assert bench.slice("waiting") == []
    with pytest.raises(Exception, match="PDF"):
        upload(bench, "invoice.png", b"%PDF-1.7")
    assert list(bench.workbench.upload_folder().iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["../depth.png", "/tmp/depth.png", "C:depth.png", "a\\b.png", "a/../../b.png"])
def test_a_descriptor_cannot_name_a_file_outside_its_folder(bench: WorkbenchDriver, name: str) -> None:
    files = depth_scan()
    fields = json.loads(files["kinect.json"]) | {"depth": name}
    before = {path for path in bench.workbench.session.folder.path.parent.rglob("*") if path.name == "depth.png"}
    drop(bench, files | {"kinect.json": json.dumps(fields).encode(), "b.png": files["depth.png"]})
    assert bench.slice("scan") is None
    assert {p for p in bench.workbench.session.folder.path.parent.rglob("*") if p.name == "depth.png"} == before


def batch(**surveys: FileSurvey) -> list[BatchFile]:
    return [BatchFile(name, name.replace("__", "."), 1, survey) for name, survey in surveys.items()]


def photo(width: int, height: int) -> FileSurvey:
    return FileSurvey("photo", "image", (), width, height)


def camera(width: int, height: int) -> FileSurvey:
    return FileSurvey("camera", "camera JSON", (), width, height)


def pairs(plan: Plan) -> dict[str, tuple[str, ...]]:
    return {step.file.id: step.photos for step in plan.steps if step.file.survey.kind == "camera"}


def test_cameras_find_their_photographs_by_name_then_by_size() -> None:
    files = batch(
        desk__jpg=photo(720, 540), wall__jpg=photo(720, 540), ir__tif=photo(320, 240),
        desk_camera__yaml=camera(720, 540), colour__json=camera(720, 540), thermal__json=camera(240, 320),
    )  # fmt: skip
    found = set()
    for order in itertools.permutations(files):
        plan = plan_batch(order, (), shown=None, has_scan=False)
        assert plan.waiting == {}
        found.add(tuple(sorted(pairs(plan).items())))
    wanted = {"colour__json": ("wall__jpg",), "desk_camera__yaml": ("desk__jpg",), "thermal__json": ("ir__tif",)}
    assert found == {tuple(sorted(wanted.items()))}


def test_rival_cameras_wait() -> None:
    files = batch(a__jpg=photo(720, 540), one__json=camera(720, 540), two__json=camera(720, 540))
    plan = plan_batch(files, (), shown=None, has_scan=False)
    assert [step.file.id for step in plan.steps] == ["a__jpg"]
    assert "two.json and one.json fit the same photograph" in plan.waiting["two__json"].said


def test_a_camera_alone_belongs_to_the_shown_photograph_unless_it_fits_another() -> None:
    photos = [PhotoTarget("p1", "a.jpg", 720, 540), PhotoTarget("p2", "b.jpg", 320, 240)]
    for shown, size, owner in (("p1", (720, 540), "p1"), ("p1", (320, 240), "p2"), ("p2", (64, 64), "p2")):
        plan = plan_batch(batch(k__json=camera(*size)), photos, shown=shown, has_scan=False)
        assert pairs(plan) == {"k__json": (owner,)}


def test_others_are_answered_while_a_batch_is_opened(bench: WorkbenchDriver) -> None:
    """What is published meanwhile must not wait for the batch, which waits for what is published."""
    answered: list[bool] = []

    def opening(_: object) -> None:
        other = threading.Thread(target=bench.workbench.batches.slice, daemon=True)
        other.start()
        other.join(60)
        answered.append(not other.is_alive())

    bench.workbench.session.subscribe(opening)
    assert kinds(drop(bench, {"photo.png": PHOTO.read_bytes()})) == ["photo"]
    assert answered
    assert all(answered)


def test_what_a_picture_or_a_camera_file_leaves_open_is_asked_for(bench: WorkbenchDriver) -> None:
    import io

    import tifffile

    warm = io.BytesIO()
    tifffile.imwrite(warm, np.linspace(18, 36, 60 * 80, dtype=np.float32).reshape(60, 80))
    drop(bench, {"warm.tif": warm.getvalue()})
    (file,) = bench.slice("waiting")
    assert file["takes"] == ["temperature_unit"]
    assert "temperatures" in file["said"]
    reply = bench.do("open_files", files=[file["id"]], reading={"temperature_unit": "C"})
    assert kinds(reply) == ["photo"]
    assert bench.slice("photos")[0]["thermal"]

    golden = Path(__file__).parents[2] / "formats" / "golden_cameras" / "kalibr.yaml"
    same_size = golden.read_bytes().replace(b"[640, 480]", b"[80, 60]").replace(b"[900.0, 901.0,", b"[90.0, 90.0,")
    drop(bench, {"chain.yaml": same_size})
    (file,) = bench.slice("waiting")
    assert file["takes"] == ["camera_name"]
    assert "cam1" in file["said"]
    assert kinds(bench.do("open_files", files=[file["id"]], reading={"camera_name": "cam2"})) == ["camera"]
    assert bench.slice("photos")[0]["camera"]["fx"] == 90


def test_a_file_of_several_scans_asks_which_one_to_open(tmp_path: Path) -> None:
    from tests.formats.test_ptx import block

    bench = open_bench(tmp_path / "project")
    path = bench.workbench.session.folder.inputs / "0123.ptx"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(block(make_scan(20, 30)) + block(make_scan(18, 25)))
    file = bench.workbench.batches.take(path, "site.ptx")
    (refused,) = bench.do("open_files", files=[file])["refused"]
    assert "it contains 2 scans; choose the one to open" in refused["error"]
    (waiting,) = bench.slice("waiting")
    assert "scan_index" in waiting["takes"]
    assert [line.partition(":")[0] for line in waiting["scans"]] == ["scan 0", "scan 1"]
    assert "grid 18 x 25" in waiting["scans"][1]
    bench.do("open_files", files=[file], reading={"scan_index": 1})
    assert bench.slice("waiting") == []
    assert (bench.slice("scan")["rows"], bench.slice("scan")["columns"]) == (18, 25)
    bench.workbench.close()


def test_the_first_scan_can_be_chosen(tmp_path: Path) -> None:
    from tests.formats.test_e57_images import write_e57

    bench = open_bench(tmp_path / "project")
    path = write_e57(bench.workbench.session.folder.inputs / "0123.e57", [])
    file = bench.workbench.batches.take(path, "site.e57")
    bench.do("open_files", files=[file])
    assert bench.slice("waiting")[0]["scans"][1].startswith("station 1: ")
    assert bench.do("open_files", files=[file], reading={"scan_index": 0})["opened"]
    bench.workbench.close()
