"""Several photographs in one run: one camera, a foreign and a damaged one among them, resumed, killed, changed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import ladarreg_core as lr
from ladarreg_core.batches.photos import photo_run
from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.batches.photos.folder import PAGE_FILE, SUMMARY_FILE
from ladarreg_core.batches.photos.journal import JOURNAL_FILE
from ladarreg_core.batches.photos.photo_summary import accepted_folders, read_photos_result
from ladarreg_core.batches.photos.photo_task import register_in_worker
from ladarreg_core.errors import Cancelled, ExportError, FormatError, OptionError
from ladarreg_core.export.outputs.integrity import check_integrity
from ladarreg_core.foundations.progress import Progress
from testing.scenes.photo_set import PhotoSet, small_photo_set, write_phone_photo, write_photo_set

pytestmark = pytest.mark.slow
FOREIGN, DAMAGED = "foreign", "damaged"


@dataclass(frozen=True)
class Site:
    """A folder with a scan and photographs, and where their results are kept."""

    folder: Path
    photos: list[Path]
    truth: PhotoSet
    cache: ContentCache

    @property
    def scan(self) -> Path:
        return self.folder / "scan.npz"

    def register(self, out: Path, photos: list[Path] | None = None, **more: object) -> lr.PhotosResult:
        return lr.register_photos(self.scan, photos or self.photos, out, cache=self.cache, **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    pytest.importorskip("embreex")
    folder = tmp_path_factory.mktemp("site")
    truth = small_photo_set("boxes", seed=2, photos=3)
    photos = write_photo_set(folder, truth, focal_error=0.02)
    foreign = small_photo_set("desk", seed=3, photos=1)
    write_phone_photo(folder / f"{FOREIGN}.jpg", foreign.pixels[0], truth.camera, focal_error=0.02)
    (folder / f"{DAMAGED}.jpg").write_bytes(photos[0].read_bytes()[:20_000])
    photos = [folder / f"{FOREIGN}.jpg", *photos, folder / f"{DAMAGED}.jpg"]
    return Site(folder, photos, truth, ContentCache(folder / "cache"))


@pytest.fixture(scope="module")
def registered(site: Site, tmp_path_factory: pytest.TempPathFactory) -> lr.PhotosResult:
    return site.register(tmp_path_factory.mktemp("results") / "out", processes=2)


@pytest.fixture
def again(registered: lr.PhotosResult, tmp_path: Path) -> Path:
    """A copy of the results, to be changed."""
    return shutil.copytree(registered.folder, tmp_path / "out")


def summary(folder: Path) -> bytes:
    return (folder / SUMMARY_FILE).read_bytes()


def written(folder: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.glob("photos/*/registration.json")}


def test_the_photographs_of_the_room_are_accepted_with_one_camera(site: Site, registered: lr.PhotosResult) -> None:
    accepted = {name: one for name, one in registered.photos.items() if one["accepted"]}
    assert len(accepted) == 3
    assert not {FOREIGN, DAMAGED} & {*accepted}
    assert not registered.accepted
    camera = registered.cameras["camera-1"]
    assert sorted(camera["pooled"]) == sorted(accepted)
    true = site.truth.camera.focal_px
    assert abs(camera["camera"]["fx"] - true) < min(3 * camera["sigmas"]["focal_px"], 0.01 * true)
    for (name, one), pose in zip(sorted(accepted.items()), site.truth.poses, strict=True):
        result = lr.read_registration(registered.photo_folder(name) / "registration.json")
        assert result.camera.as_fields() == camera["camera"]
        assert result.camera_from_scanner.matrix == pytest.approx(np.array(one["camera_from_scanner"]))
        assert result.camera_from_scanner.distance_to(pose) < 0.03
        assert result.camera_from_scanner.distance_to(pose) < 4 * result.sigma_position_m
        assert one["camera"] == "camera-1"


def test_a_foreign_photograph_is_refused_and_changes_no_other(site: Site, registered: lr.PhotosResult) -> None:
    foreign = registered.photos[FOREIGN]
    assert (foreign["accepted"], foreign["camera_from_scanner"], foreign["scans"]) == (False, None, [])
    assert (registered.photo_folder(FOREIGN) / "registration.json").is_file()
    assert FOREIGN not in registered.cameras["camera-1"]["pooled"]


def test_a_damaged_photograph_is_named_and_stops_no_other(registered: lr.PhotosResult) -> None:
    damaged = registered.photos[DAMAGED]
    assert damaged["verdict"].startswith("Failed")
    assert "damaged" in damaged["reasons"][0]
    assert damaged["folder"] is None
    assert not registered.photo_folder(DAMAGED).exists()


def test_the_page_has_the_failures_first_and_refers_to_nothing_outside(registered: lr.PhotosResult) -> None:
    page = (registered.folder / PAGE_FILE).read_text(encoding="utf-8")
    places = [page.index(f"<b>{name}.jpg</b>") for name in (DAMAGED, FOREIGN, "IMG_0001", "IMG_0002")]
    assert places == sorted(places)
    assert page.count("data:image/jpeg;base64,") == 4
    assert "<script" not in page
    assert "http" not in page.replace("http-equiv", "")
    assert "3 of 5 accepted" in page


def test_the_folder_is_intact_and_reads_back(registered: lr.PhotosResult) -> None:
    found = check_integrity(registered.folder)
    assert not found.damaged
    assert found.files > 20
    assert read_photos_result(registered.folder).photos.keys() == registered.photos.keys()
    assert len(accepted_folders(registered.folder)) == 3


def test_run_again_nothing_is_done_twice(site: Site, again: Path) -> None:
    before, was = written(again), summary(again)
    site.register(again)
    assert written(again) == before
    assert summary(again) == was


def test_what_is_missing_or_was_added_is_done_and_nothing_else(site: Site, again: Path) -> None:
    before, was = written(again), summary(again)
    shutil.rmtree(again / "photos" / "IMG_0002")
    site.register(again, processes=1)
    after = written(again)
    assert {name for name in after if after[name] != before.get(name)} == {"IMG_0002"}
    assert summary(again) == was, "the same with another number of processes"


@pytest.mark.long
def test_a_zoomed_photograph_with_the_same_exif_is_refused_and_changes_no_other(site: Site, again: Path) -> None:
    with Image.open(site.photos[3]) as image:
        width, height = image.size
        part = (0.03 * width, 0.03 * height, 0.97 * width, 0.97 * height)
        pixels = np.asarray(image.resize(image.size, Image.Resampling.BICUBIC, box=part))
    zoomed = again.parent / "zoomed.jpg"
    write_phone_photo(zoomed, pixels, site.truth.camera, focal_error=0.02)
    before = written(again)
    result = site.register(again, [*site.photos, zoomed])
    assert result.cameras["camera-1"]["disagreeing"] == ["zoomed"]
    assert not result.photos["zoomed"]["accepted"]
    assert "zoomed or cropped" in result.photos["zoomed"]["reasons"][0]
    after = written(again)
    assert {name for name in after if after[name] != before.get(name)} == {"zoomed"}


@pytest.mark.long
def test_other_options_are_refused_unless_they_may_replace(site: Site, again: Path) -> None:
    was = summary(again)
    with pytest.raises(ExportError, match=r"other photos, inputs or options.*`force=True`"):
        site.register(again, options=replace(lr.RegisterOptions(), seed=1))
    with pytest.raises(ExportError, match="IMG_0001"):
        site.register(again, [site.photos[2]])
    assert summary(again) == was
    result = site.register(again, [site.photos[2]], force=True)
    assert [*result.photos] == ["IMG_0002"]
    assert {path.name for path in (again / "photos").iterdir()} == {"IMG_0002"}


def test_what_others_wrote_is_never_replaced(site: Site, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(ExportError, match=r"notes\.txt"):
        site.register(tmp_path / "out", force=True)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["notes.txt"]


@pytest.mark.long
def test_a_changed_result_is_not_replaced_by_force(site: Site, again: Path) -> None:
    edited = again / "photos" / "IMG_0001" / "registered.png"
    edited.write_bytes(b"my own picture")
    result = site.register(again, [site.photos[1]], force=True)
    assert "registered.png" in result.photos["IMG_0001"]["reasons"][0]
    assert edited.read_bytes() == b"my own picture"


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"photos": []}, OptionError, "no photo"),
        ({"photos": ["missing.jpg"]}, OptionError, "missing.jpg: file not found"),
        ({"scan": "missing.npz"}, OptionError, "missing.npz: file not found"),
        ({"processes": 0}, OptionError, "processes"),
        ({"frame": "world"}, OptionError, "world"),
    ],
)
def test_bad_input_of_the_whole_leaves_nothing(
    site: Site, tmp_path: Path, change: dict[str, object], error: type[Exception], words: str
) -> None:
    arguments: dict[str, object] = {"scan": site.scan, "photos": site.photos, "cache": site.cache, **change}
    with pytest.raises(error, match=words):
        lr.register_photos(folder=tmp_path / "out", **arguments)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_where_all_fail_the_summary_says_so_and_the_run_can_be_repeated(site: Site, tmp_path: Path) -> None:
    for _ in range(2):
        result = site.register(tmp_path / "out", [site.folder / f"{DAMAGED}.jpg"])
        assert not result.accepted
        assert (tmp_path / "out" / PAGE_FILE).is_file()
        assert not check_integrity(tmp_path / "out").damaged


def test_a_scan_that_is_none_leaves_nothing(site: Site, tmp_path: Path) -> None:
    with pytest.raises(FormatError):
        lr.register_photos(site.photos[1], [site.photos[2]], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_that_is_cancelled_before_anything_is_done_leaves_nothing(site: Site, tmp_path: Path) -> None:
    def stop(progress: Progress) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        site.register(tmp_path / "out", report=stop)
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_cancelled_run_goes_on_where_it_was(site: Site, tmp_path: Path) -> None:
    said: list[str] = []

    def stop(progress: Progress) -> None:
        said.append(progress.label)
        if sum(label.endswith("estimated") for label in said) == 2:
            raise Cancelled

    out, photos = tmp_path / "out", [site.photos[1], site.photos[2]]
    with pytest.raises(Cancelled):
        site.register(out, photos, report=stop)
    assert (out / JOURNAL_FILE).is_file()
    assert not list(out.glob("photos/*"))
    with pytest.raises(FormatError, match="not finished"):
        read_photos_result(out)
    before = (out / JOURNAL_FILE).read_bytes()
    assert site.register(out, photos).accepted
    assert (out / JOURNAL_FILE).read_bytes().startswith(before)


def _die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _die_for(name: str) -> Callable[..., object]:
    return _die if name == "IMG_0001" else register_in_worker


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_killed_worker_is_reported_for_its_photograph_and_stops_no_other(
    site: Site, again: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("IMG_0001", "IMG_0002"):
        shutil.rmtree(again / "photos" / name)
    real = photo_run.WorkerProcesses.submit

    def submit(self: photo_run.WorkerProcesses, fn: object, task: object, *args: object) -> object:
        return real(self, _die_for(getattr(task, "id", "")), task, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(photo_run.WorkerProcesses, "submit", submit)
    result = site.register(again)
    assert "was killed" in result.photos["IMG_0001"]["reasons"][0]
    assert result.photos["IMG_0002"]["accepted"]
    monkeypatch.undo()
    assert site.register(again).photos["IMG_0001"]["accepted"], "what failed is tried again"


def test_numbers_of_the_summary_are_plain_json(registered: lr.PhotosResult) -> None:
    fields = json.loads(summary(registered.folder))
    assert fields["kind"] == "adjustment"
    assert {*fields["scans"]} == {"scan-1"}
    assert all(len(one["covariance"]) == 6 for one in fields["photos"].values() if one["accepted"])
    assert "seconds" not in json.dumps(fields["photos"]), "times would differ from run to run"
