"""What every test may ask for."""

from __future__ import annotations

import os
import zlib
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# Helpers that assert explain their failures as tests do.
pytest.register_assert_rewrite("testing")

from testing.scenes import kept  # noqa: E402

# One browser and one workbench for all tests of a process.
from testing.workbench.pages import browser, browser_3d, browsers, page, page_3d, pytest_runtest_makereport  # noqa: E402
from testing.workbench.shared import workbench  # noqa: E402

__all__ = ["browser", "browser_3d", "browsers", "page", "page_3d", "pytest_runtest_makereport", "workbench"]

CHECKOUT = Path(__file__).resolve().parent.parent

# One seed for all runs: a failure found once is found again, and the machine's load never fails a law.
settings.register_profile("ladarreg", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("ladarreg")


FIRST = ("tests/architecture/test_types.py", "tests/e2e/", "tests/page/", "tests/app/scene/", "tests/abuse/")
"""What takes longest, or shares one browser and one workbench, which most workers then need not start."""
_SHARES = {"long": 60, "slow": 20}
"""Of the tests with a mark, a text draws one in so many; what is marked long and slow counts as long."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the choice of tests marked long."""
    parser.addoption(
        "--long", default="none", metavar="none|all|share:TEXT",
        help=f"tests marked long: none of them, all, or the share of 1 in {_SHARES['long']} that a text draws, such as "
        f"the commit's hash, and then also only 1 in {_SHARES['slow']} of those marked slow",
    )  # fmt: skip


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests that were not asked for or not drawn; let each worker begin with what takes longest.

    Each of the workers gets the same number of consecutive tests, and takes from the ends of the others' later.
    """
    which = str(config.getoption("--long"))
    if which not in ("none", "all") and not which.startswith("share:"):
        raise pytest.UsageError(f"--long is {which!r}; give none, all, or share:TEXT")

    def runs(item: pytest.Item) -> bool:
        mark = next((each for each in _SHARES if item.get_closest_marker(each) is not None), None)
        if mark is None or which == "all":
            return True
        if which == "none":
            return mark != "long"
        return zlib.crc32(f"{item.nodeid} {which.removeprefix('share:')}".encode()) % _SHARES[mark] == 0

    left_out = [item for item in items if not runs(item)]
    items[:] = [item for item in items if runs(item)]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
    if which.startswith("share:"):
        config.stash[SHARE] = [item.nodeid for item in items if item.get_closest_marker("long") is not None]

    def rank(item: pytest.Item) -> int:
        return next((k for k, start in enumerate(FIRST) if item.nodeid.startswith(start)), len(FIRST))

    items.sort(key=rank)
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        items[:] = _dealt(items, workers)


def _dealt(items: list[pytest.Item], workers: int) -> list[pytest.Item]:
    """Return an order in which one worker begins with the types and all with marked tests, those of a file together."""

    def takes_long(item: pytest.Item) -> bool:
        return item.nodeid.startswith(FIRST[0]) or any(item.get_closest_marker(each) is not None for each in _SHARES)

    marked = [item for item in items if takes_long(item)]
    files = [list(group) for _, group in groupby(marked, lambda item: item.path)]
    hands: list[list[pytest.Item]] = [[] for _ in range(workers)]
    for group in sorted(files, key=lambda group: (not group[0].nodeid.startswith(FIRST[0]), -len(group))):
        min(hands, key=len).extend(group)
    taken = set(map(id, marked))
    others = (item for item in items if id(item) not in taken)
    sizes = [(len(items) + k) // workers for k in range(workers)]  # the last ones are the larger ones
    for hand, size in zip(hands, sizes, strict=True):
        hand.extend(islice(others, max(size - len(hand), 0)))
    hands[-1].extend(others)
    return [item for hand in hands for item in hand]


SHARE = pytest.StashKey[list[str]]()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take from a worker which of the long tests were drawn: all workers collect the same ones."""
    node.config.stash[SHARE] = getattr(node, "workeroutput", {}).get("long tests", [])


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send them from a worker."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["long tests"] = session.config.stash.get(SHARE, [])


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print them."""
    if str(config.getoption("--long")).startswith("share:"):
        drawn = config.stash.get(SHARE, [])
        terminalreporter.write_line("\n".join([f"long tests drawn: {len(drawn)}", *(f"  {name}" for name in drawn)]))


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
