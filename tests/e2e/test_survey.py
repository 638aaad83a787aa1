"""The step Survey: the list of all photographs, and one press that solves them together."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from testing.workbench.operator import Operator, at_work
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow


@pytest.fixture
def operator(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator at a project whose photograph is registered."""
    workbench.open("solved")
    with at_work(browser, workbench.server, request) as found:
        found.open()
        yield found


def test_photographs_are_adjusted_and_taken_back(operator: Operator) -> None:
    page = operator.page
    page.set_default_timeout(240_000)
    operator.step("Survey")
    part = page.get_by_role("region", name="All photographs")
    part.get_by_text("1 of 1 accepted").wait_for()
    part.get_by_role("button", name="Adjust", exact=True).click()
    part.get_by_text(re.compile("Adjusted together: 1 of 1")).wait_for()
    part.get_by_label("Choose photo.png").check()
    assert part.get_by_role("button", name="Register 1", exact=True).is_enabled()
    page.get_by_role("button", name=re.compile("Undo")).first.click()
    part.get_by_text(re.compile("^Adjust solves all photographs")).wait_for()
    part.get_by_text("1 of 1 accepted").wait_for()
