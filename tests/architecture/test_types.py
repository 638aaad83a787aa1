"""The types: mypy, beside the other tests, with its cache in the checkout."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.timeout(3600)
def test_mypy_finds_no_fault(checkout: Path) -> None:
    done = subprocess.run([sys.executable, "-m", "mypy"], cwd=checkout, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
