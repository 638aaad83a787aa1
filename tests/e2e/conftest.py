"""An operator at the workbench that all tests share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from testing.workbench.operator import Operator, at_work
from testing.workbench.page_truth import facts_of
from testing.workbench.shared import SharedWorkbench
from testing.workbench.walk import Walk

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(autouse=True)
def _tabs_are_closed(request: pytest.FixtureRequest) -> Iterator[None]:
    """Close the tabs that a test leaves open, as one that fails does: they would be further clients of the next one."""
    browsers = [request.getfixturevalue(name) for name in ("browser", "browser_3d") if name in request.fixturenames]
    before = [context for browser in browsers for context in browser.contexts]
    yield
    for context in [context for browser in browsers for context in browser.contexts]:
        if context not in before:
            context.close()


@pytest.fixture
def operator(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator at a project of his or her own: the sample, with its camera."""
    workbench.open("camera")
    with at_work(browser, workbench.server, request) as found:
        found.open()
        yield found


@pytest.fixture
def onlooker(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator who changes nothing in the sample with its camera."""
    workbench.look_at("camera")
    with at_work(browser, workbench.server, request) as found:
        found.open()
        yield found


@pytest.fixture
def walk(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Walk]:
    """A walk that begins with nothing open."""
    workbench.open_new()
    with at_work(browser, workbench.server, request, size=(1440, 900)) as operator:
        found = Walk(operator, workbench)
        operator.open()
        operator.page.keyboard.press("Escape")
        found.constants = [text for _, _, text in facts_of(operator.page)["rest"]]
        yield found
