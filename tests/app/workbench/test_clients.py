"""Several people at one workbench: what belongs to each of them, and how a returning page is recognised."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from ladarreg.gateway.protocol import Visitor
from ladarreg.workbench.state.clients import COLORS, MAX_CLIENTS, Client, Clients

from ladarreg_core.errors import OptionError
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench, sample_bench


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    found = sample_bench(tmp_path_factory.mktemp("people") / "project")
    yield found
    found.workbench.close()


@pytest.fixture
def colleague(bench: WorkbenchDriver) -> Iterator[WorkbenchDriver]:
    """A second person, with the messages that he or she receives."""
    client = bench.workbench.join(Visitor("elsewhere"))
    other = WorkbenchDriver(bench.workbench, client)
    end = bench.workbench.subscribe(other.received.append, client)
    yield other
    end()
    bench.workbench.leave(client)


def clients_alone() -> Clients:
    return Clients(lambda: None)


def test_readers_take_no_page_that_is_reserved_for_editors() -> None:
    clients = clients_alone()
    readers = [clients.join(Visitor("reader", read_only=True)) for _ in range(MAX_CLIENTS // 2)]
    with pytest.raises(OptionError, match="32 read-only pages are open"):
        clients.join(Visitor("reader", read_only=True))
    for _ in range(MAX_CLIENTS // 2):
        clients.join(Visitor("editor"))
    for read_only in (False, True):
        with pytest.raises(OptionError, match="64 pages are open"):
            clients.join(Visitor("another", read_only=read_only))
    clients.leave(readers[0])
    clients.join(Visitor("editor"))


def second_photo(bench: WorkbenchDriver, by: Client) -> str:
    path = bench.workbench.upload_folder() / "second.png"
    path.write_bytes(next(sample_folder().glob("photo.*")).read_bytes())
    return bench.workbench.take_upload(path, "second.png", "photo", None, by)


@pytest.mark.slow
def test_an_edit_leaves_what_is_published_of_other_photographs_alone(bench: WorkbenchDriver) -> None:
    second_photo(bench, bench.client)
    third = second_photo(bench, bench.client)
    before = bench.workbench.slices(bench.client)
    bench.do("add_pick", photo="p1", kind="point", scan=[[1, 0, 0]], photo_uv=[[10, 20]])
    after = bench.workbench.slices(bench.client)
    assert after["picks:p1"] != before["picks:p1"]
    for name in ("picks", "poses", "progress", "outline", "ties"):
        assert after[f"{name}:{third}"] is before[f"{name}:{third}"], f"{name} was made again"
    listed = [{photo["id"]: photo for photo in slices["photos"]} for slices in (before, after)]
    assert listed[1][third] is listed[0][third]
    bench.do("set_camera", photo=third, focal_px=500.0)
    assert bench.slice("photos")[-1]["camera"]["fx"] == 500.0, "what it rests on has changed"
    for _ in range(4):
        bench.do("undo")


def told(driver: WorkbenchDriver, name: str) -> list[Any]:
    """Return the values of a slice in all messages since the last call, the last one last."""
    found = [message["slices"][name] for message in driver.received if name in message.get("slices", {})]
    driver.received.clear()
    return found


def test_a_photograph_that_a_colleague_adds_is_shown_to_the_colleague_only(
    bench: WorkbenchDriver, colleague: WorkbenchDriver
) -> None:
    bench.received.clear()
    added = second_photo(bench, colleague.client)
    assert colleague.slice("shown") == added
    assert told(colleague, "shown") == [added]
    assert bench.slice("shown") == "p1"
    assert told(bench, "shown") == []
    seen = {each["id"]: each["photo"] for each in bench.slice("people")["clients"]}
    assert seen == {bench.client.id: "p1", colleague.client.id: added}, "everybody knows who looks at what"

    bench.do("show_photo", photo=added)
    colleague.do("show_photo", photo="p1")
    assert (bench.slice("shown"), colleague.slice("shown")) == (added, "p1")
    colleague.do("remove_photo", photo=added)
    assert bench.slice("shown") == "p1", "what is left"


def test_a_file_without_a_photograph_belongs_to_the_one_that_its_sender_sees(
    bench: WorkbenchDriver, colleague: WorkbenchDriver
) -> None:
    added = second_photo(bench, colleague.client)
    camera = bench.workbench.upload_folder() / "camera.json"
    camera.write_bytes((sample_folder() / "camera.json").read_bytes())
    assert bench.workbench.take_upload(camera, "camera.json", "camera", None, bench.client) == "p1"
    camera.write_bytes((sample_folder() / "camera.json").read_bytes())
    assert bench.workbench.take_upload(camera, "camera.json", "camera", None, colleague.client) == added


def test_the_display_of_the_model_is_ones_own(bench: WorkbenchDriver, colleague: WorkbenchDriver) -> None:
    colleague.do("set_model", texture="intensity", rays=True)
    assert (colleague.slice("model")["texture"], colleague.slice("model")["rays"]) == ("intensity", True)
    assert (bench.slice("model")["texture"], bench.slice("model")["rays"]) == ("colour", False)


def test_each_client_is_told_who_it_is(bench: WorkbenchDriver, colleague: WorkbenchDriver) -> None:
    mine, theirs = bench.slice("people"), colleague.slice("people")
    assert mine["clients"] == theirs["clients"]
    assert (mine["you"], theirs["you"]) == (bench.client.id, colleague.client.id)
    assert len({each["colour"] for each in mine["clients"]}) == 2


def test_a_tab_is_recognised_when_it_returns() -> None:
    clients = clients_alone()
    first = clients.join(Visitor("a", tab="browser tab-one", page="1"))
    first.photo = "p2"
    clients.rename(first, "Ann")
    clients.leave(first)
    assert clients.join(Visitor("a", tab="browser tab-two", page="2")) is not first
    again = clients.join(Visitor("b", tab="browser tab-one", page="3", name="Eve", photo="p1"))
    assert (again.id, again.name, again.photo, again.address) == (first.id, "Ann", "p2", "b")


def test_after_a_restart_the_page_reminds_the_workbench() -> None:
    before = clients_alone().join(Visitor("a", tab="browser tab-one", page="1"))
    restarted = clients_alone()
    after = restarted.join(Visitor("a", tab="browser tab-one", page="1", name=" Ann\n", photo="p2"))
    assert (after.id, after.name, after.photo) == (before.id, "Ann", "p2")
    other = restarted.join(Visitor("a", tab="browser tab-two", page="1", name="Ann"))
    assert other.name == "Ann (2)"


def test_a_page_that_reconnects_takes_its_place_before_the_old_connection_has_ended() -> None:
    clients = clients_alone()
    first = clients.join(Visitor("a", tab="browser tab", page="1"))
    assert clients.join(Visitor("a", tab="browser tab", page="1")) is first
    assert clients.present == [first]
    clients.leave(first)
    assert clients.present == [first], "one of two connections"
    clients.leave(first)
    assert clients.present == []


def test_a_reloaded_page_waits_for_its_old_connection_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.workbench.state.clients._RELOAD_S", 60.0)
    clients = clients_alone()
    first = clients.join(Visitor("a", tab="browser tab", page="1"))
    waiting = threading.Timer(0.05, clients.leave, [first])
    waiting.start()
    assert clients.join(Visitor("a", tab="browser tab", page="2")) is first
    waiting.join()


@pytest.mark.slow
def test_a_copied_tab_is_somebody_else_and_stays_so() -> None:
    clients = clients_alone()
    first = clients.join(Visitor("a", tab="browser tab", page="1"))
    copy = clients.join(Visitor("a", tab="browser tab", page="2"))
    assert copy.id != first.id
    clients.leave(copy)
    assert clients.join(Visitor("a", tab="browser tab", page="2")) is copy
    assert clients.present == [first, copy]


def test_ids_do_not_reveal_the_secret_and_belong_to_one_browser() -> None:
    clients = clients_alone()
    ids = [clients.join(Visitor("a", tab=tab, page="1")).id for tab in ("one secret", "two secret", "", "")]
    assert len(set(ids)) == 4
    assert all(set("secret") - set(name) or len(name) == 12 for name in ids)


def test_colors_are_distinct_while_there_are_enough() -> None:
    clients = clients_alone()
    everybody = [clients.join(Visitor("a")) for _ in range(COLORS + 3)]
    assert sorted(each.color for each in everybody[:COLORS]) == list(range(1, COLORS + 1))
    assert all(1 <= each.color <= COLORS for each in everybody)
    clients.leave(everybody[2])
    assert clients.join(Visitor("a")).color == everybody[2].color


# undo among several people

LINE: dict[str, Any] = {"kind": "line", "scan": [[1, 0, 0], [1, 0.1, 0.02]], "photo_uv": [[300, 200], [410, 220]]}


def numbers(driver: WorkbenchDriver) -> list[int]:
    return [pick["number"] for pick in driver.slice("picks:p1")]


def test_among_others_undo_takes_back_ones_own_last_edit(bench: WorkbenchDriver, colleague: WorkbenchDriver) -> None:
    before = numbers(bench)
    mine = int(bench.do("add_pick", photo="p1", **LINE)["pick"])
    theirs = int(colleague.do("add_pick", photo="p1", **LINE)["pick"])
    assert bench.slice("project")["undo"] == f"Draw line {mine}"
    assert colleague.slice("project")["undo"] == f"Draw line {theirs}"
    bench.do("undo")
    assert numbers(colleague) == [*before, theirs]
    assert bench.slice("project")["redo"] == f"Draw line {mine}"
    assert colleague.slice("project")["redo"] is None
    bench.do("redo")
    assert numbers(bench) == [*before, mine, theirs]
    colleague.do("undo")
    bench.do("undo")
    assert numbers(bench) == before
    entry = bench.slice("history")["entries"][-1]
    assert (entry["label"], entry["author"]) == (f"Undo Draw line {mine}", bench.client.name)


def test_an_undo_that_would_take_back_anothers_edit_says_whose(
    bench: WorkbenchDriver, colleague: WorkbenchDriver
) -> None:
    mine = bench.do("add_pick", photo="p1", **LINE)["pick"]
    colleague.do("set_pick", photo="p1", pick=mine, weight=2)
    before = bench.workbench.session.document
    refusal = bench.refused("undo")
    assert refusal.startswith(f"{colleague.client.name} changed match {mine} since ('Weight match {mine}', ")
    assert "open History" in refusal
    assert bench.workbench.session.document is before
    colleague.do("undo")
    bench.do("undo")
    assert int(mine) not in numbers(bench)


def test_whoever_is_alone_undoes_everything_as_before(bench: WorkbenchDriver, colleague: WorkbenchDriver) -> None:
    theirs = int(colleague.do("add_pick", photo="p1", **LINE)["pick"])
    assert bench.slice("project")["undo"] != f"Draw line {theirs}"
    bench.workbench.leave(colleague.client)
    assert bench.slice("project")["undo"] == f"Draw line {theirs}"
    at = len(bench.slice("history")["entries"])
    bench.do("undo")
    assert theirs not in numbers(bench)
    assert len(bench.slice("history")["entries"]) == at, "one step back, not a new one"
    bench.do("redo")
    assert theirs in numbers(bench)
    bench.workbench.clients.join(Visitor("elsewhere"))
    bench.workbench.leave(bench.workbench.clients.present[-1])


def test_one_step_can_be_undone_by_its_number(bench: WorkbenchDriver) -> None:
    first = int(bench.do("add_pick", photo="p1", **LINE)["pick"])
    step = bench.slice("history")["at"]
    second = int(bench.do("add_pick", photo="p1", **LINE)["pick"])
    bench.do("undo", n=step)
    assert first not in numbers(bench)
    assert second in numbers(bench)
    assert "undone already" in bench.refused("undo", n=step)
    bench.do("redo", n=step)
    assert first in numbers(bench)
    assert "not the one" in bench.refused("redo", n=step)


def test_everybody_is_told_who_went_to_another_state(bench: WorkbenchDriver, colleague: WorkbenchDriver) -> None:
    at = bench.slice("history")["at"]
    label = next(entry["label"] for entry in bench.slice("history")["entries"] if entry["n"] == 1)
    bench.received.clear()
    colleague.do("go_to", n=1)
    (notice,) = [message["text"] for message in bench.received if message.get("event") == "notice"]
    assert notice.startswith(f"{colleague.client.name} went to '{label}' of ")
    assert not [message for message in colleague.received if message.get("event") == "notice"]
    colleague.do("go_to", n=at)


@pytest.mark.slow
def test_own_steps_are_known_after_a_restart(tmp_path_factory: pytest.TempPathFactory) -> None:
    home = tmp_path_factory.mktemp("restarted") / "project"
    first = sample_bench(home)
    ann = first.workbench.join(Visitor("a", tab="browser tab", page="1"))
    first.workbench.answer(ann, {"id": 1, "do": "add_pick", "photo": "p1", **LINE})
    mine = numbers(first)[-1]
    theirs = int(first.do("add_pick", photo="p1", **LINE)["pick"])
    first.workbench.answer(ann, {"id": 2, "do": "undo"})
    assert numbers(first) == [theirs]
    first.workbench.close()
    again = open_bench(home)
    try:
        ann = again.workbench.join(Visitor("a", tab="browser tab", page="1"))
        reply = again.workbench.answer(ann, {"id": 1, "do": "redo"})
        assert reply["ok"], reply
        assert numbers(again) == [mine, theirs]
    finally:
        again.workbench.close()


# following, and the pointers of others


def events(driver: WorkbenchDriver, kind: str) -> list[dict[str, Any]]:
    return [message for message in driver.received if message.get("event") == kind]


def test_whoever_follows_sees_what_the_other_sees(bench: WorkbenchDriver, colleague: WorkbenchDriver) -> None:
    added = second_photo(bench, bench.client)
    bench.do("show_photo", photo="p1")
    colleague.do("show_photo", photo="p1")
    colleague.do("follow", client=bench.client.id)
    colleague.received.clear()
    bench.do("show_photo", photo=added)
    assert colleague.slice("shown") == added
    assert told(colleague, "shown") == [added]
    assert "follows you already" in bench.refused("follow", client=colleague.client.id)
    assert "not connected" in colleague.refused("follow", client=colleague.client.id)
    assert "not connected" in colleague.refused("follow", client="nobody")
    colleague.do("show_photo", photo="p1")
    bench.do("show_photo", photo="p1")
    bench.do("show_photo", photo=added)
    assert colleague.slice("shown") == "p1", "selecting a photograph ends it"
    colleague.do("follow", client=bench.client.id)
    colleague.do("follow", client=None)
    assert colleague.slice("shown") == added, "what was seen last stays"
    bench.do("show_photo", photo="p1")
    assert colleague.slice("shown") == added


def test_pointers_go_to_the_others_and_views_to_those_who_follow(
    bench: WorkbenchDriver, colleague: WorkbenchDriver
) -> None:
    bench.received.clear()
    where = {"side": "photo", "photo": "p1", "view": 0}
    bench.do("point", uv=[10.5, 20], **where)
    sent = {"event": "cursor", "client": bench.client.id, "uv": [10.5, 20.0], "station": "", **where}
    assert events(colleague, "cursor") == [sent]
    bench.do("show_view", centre=[1, 2], zoom=2, **where)
    assert events(colleague, "view") == []
    colleague.do("follow", client=bench.client.id)
    bench.do("show_view", centre=[1, 2], zoom=2, **where)
    assert [event["zoom"] for event in events(colleague, "view")] == [2]
    bench.do("point", uv=None, **where)
    assert events(colleague, "cursor")[-1]["uv"] is None
    assert events(bench, "cursor") == events(bench, "view") == []
    for wrong in ({"side": "left"}, {"view": -1}, {"view": 10**9}, {"uv": [1]}, {"uv": ["a", 2]}, {"uv": [1e9, 0]}):
        bench.refused("point", **{"uv": [1, 2], **where, **wrong})
    for zoom in (0, -1, "big", None, 1e99):
        bench.refused("show_view", centre=[1, 2], zoom=zoom, **where)
    colleague.do("follow", client=None)


def test_alone_nobody_is_sent_a_pointer(bench: WorkbenchDriver) -> None:
    bench.received.clear()
    bench.do("point", side="scan", photo=None, view=0, uv=[1, 2])
    assert bench.received == []
