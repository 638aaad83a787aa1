"""Loads what the work of all cases needs, so that the processes that are forked from here load no code.

A library that is loaded with no memory left may wait for ever (OpenBLAS); that is not what is tested here.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import ladarreg.cli
import ladarreg.session.session

from testing.attacks import fault_rounds
from testing.attacks.fault_cases import CASES

LOADED = (ladarreg.cli, ladarreg.session.session, fault_rounds)
ladarreg.session.session.RETRY_S = 0.05

with tempfile.TemporaryDirectory(prefix="faults-") as _name:
    for _number, _case in enumerate(CASES.values()):
        _room, _beside = Path(_name, f"room-{_number}"), Path(_name, f"beside-{_number}")
        _case.prepare(_room, _beside)
        _case.work(_room, _beside, lambda done: None)
