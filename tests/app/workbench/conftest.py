"""A workbench of its own for each test that asks for no other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    """A workbench with the sample, which solves nothing by itself."""
    found = sample_bench(tmp_path / "project")
    yield found
    found.workbench.close()
