"""Several people at one workbench: what belongs to each of them, and how a returning page is recognised."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from ladarreg.gateway.protocol import Visitor
from ladarreg.workbench.clients import COLOURS, Client, Clients

from ladarreg_core.simulate.sample import sample_folder
from tests.app.workbench_driver import WorkbenchDriver, sample_bench


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


def second_photo(bench: WorkbenchDriver, by: Client) -> str:
    path = bench.workbench.upload_folder() / "second.png"
    path.write_bytes(next(sample_folder().glob("photo.*")).read_bytes())
    return bench.workbench.take_upload(path, "second.png", "photo", None, by)


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
    colleague.do("set_model", texture="intensity", light=True)
    assert (colleague.slice("model")["texture"], colleague.slice("model")["light"]) == ("intensity", True)
    assert (bench.slice("model")["texture"], bench.slice("model")["light"]) == ("colour", False)


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


def test_a_reloaded_page_waits_for_its_old_connection_to_end() -> None:
    clients = clients_alone()
    first = clients.join(Visitor("a", tab="browser tab", page="1"))
    waiting = threading.Timer(0.05, clients.leave, [first])
    waiting.start()
    assert clients.join(Visitor("a", tab="browser tab", page="2")) is first
    waiting.join()


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


def test_colours_are_distinct_while_there_are_enough() -> None:
    clients = clients_alone()
    everybody = [clients.join(Visitor("a")) for _ in range(COLOURS + 3)]
    assert sorted(each.colour for each in everybody[:COLOURS]) == list(range(1, COLOURS + 1))
    assert all(1 <= each.colour <= COLOURS for each in everybody)
    clients.leave(everybody[2])
    assert clients.join(Visitor("a")).colour == everybody[2].colour
