"""Two stop signals in quick succession while a client edits."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from testing.attacks.stop_rounds import stopped_while_editing

pytestmark = pytest.mark.skipif(os.name != "posix", reason="no such signals")


@pytest.mark.slow
@pytest.mark.parametrize("first", ["SIGHUP", pytest.param("SIGINT", marks=pytest.mark.long)])
def test_two_signals_end_the_server_in_order_and_lose_no_edit(tmp_path: Path, first: str) -> None:
    found = stopped_while_editing(tmp_path, signal.Signals[first], signal.SIGTERM, apart_s=0.02)
    assert found.faults == []
    assert found.answered > 5
