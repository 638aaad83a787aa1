"""What every test may ask for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Helpers that assert explain their failures as tests do.
pytest.register_assert_rewrite("testing")

from testing.scenes import kept  # noqa: E402

# One browser for all tests of a process: two would each want the process's only event loop.
from testing.workbench.pages import browser, page, pytest_runtest_makereport  # noqa: E402

__all__ = ["browser", "page", "pytest_runtest_makereport"]

CHECKOUT = Path(__file__).resolve().parent.parent

# One seed for all runs: a failure found once is found again, and the machine's load never fails a law.
settings.register_profile("ladarreg", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("ladarreg")


LONGEST_FIRST = ("tests/e2e/", "tests/abuse/", "tests/registration/", "tests/unit/acquisition/", "tests/app/")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that no core is left with one of them when the others have ended."""

    def rank(item: pytest.Item) -> int:
        return next((k for k, start in enumerate(LONGEST_FIRST) if item.nodeid.startswith(start)), len(LONGEST_FIRST))

    items.sort(key=rank)


@pytest.fixture(scope="session", autouse=True)
def _scenes_are_shared(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What one worker has made, the others of the run read."""
    own = tmp_path_factory.getbasetemp()
    kept.share((own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "kept")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scans and photographs, which are not part of the project."""
    folder = Path(os.environ.get("LADARREG_DATA") or CHECKOUT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no real data: set LADARREG_DATA (looked in {folder})")
    return folder


@pytest.fixture(scope="session")
def checkout() -> Path:
    """The top of the source tree."""
    return CHECKOUT
