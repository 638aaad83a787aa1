"""Runs on simulated devices, and what they have kept."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.acquisition.devices.flir_unit import FlirUnit
from ladarreg_core.acquisition.devices.ports import Ports, PortSource
from ladarreg_core.acquisition.devices.scip_scanner import ScipScanner
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.plan_reading import plan_from_fields
from ladarreg_core.acquisition.runs.connected import connected
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter, ScanPiece
from ladarreg_core.acquisition.runs.runner import Paused, Run, RunEvent
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from ladarreg_core.acquisition.simulated.world import LINE_MOUNT

CHECKOUT = Path(__file__).resolve().parents[3]


class Devices:
    """Connected drivers of the simulated devices.

    Args:
        twins: the devices.
        ports: to reach them by.
    """

    def __init__(self, twins: TwinDevices, ports: PortSource) -> None:
        self.twins, self.clock = twins, ports.clock
        at = twins.addresses
        self.unit_plan = UnitPlan(at["flir-ptu"], baud=115_200)
        self.scanner_plan = ScannerPlan("scip2", at["scip2"], lines=2)
        self.unit = FlirUnit.connect(ports, self.unit_plan)
        self.scanner = ScipScanner.connect(ports, self.scanner_plan)

    def plan(self, **changes: Any) -> Plan:
        fields: dict[str, Any] = {"pan": Axis(-4, 4, 1), "tilt": Axis(0, 0, 0), "settle_s": 0.0, **changes}
        return Plan(self.unit_plan, self.scanner_plan, "sweep", mount=LINE_MOUNT, **fields)

    def run(self, folder: RunWriter, events: list[RunEvent], on_event: Any = None, *, fails: bool = False) -> Run:
        def report(event: RunEvent) -> None:
            events.append(event)
            assert fails or not (isinstance(event, Paused) and event.fault), event  # it would wait for ever
            if on_event is not None:
                on_event(event)

        for device in (self.unit, self.scanner):
            device.link.log_to(folder.exchanges.add)
        return Run(folder.plan, folder, unit=self.unit, line_scanner=self.scanner, report=report, clock=self.clock)

    def are_at_rest(self) -> bool:
        state = self.twins.state()
        return not state["moving"] and not state["laser_on"]

    def come_to_rest(self) -> bool:
        """Return whether the devices come to rest; how soon is measured by a benchmark."""
        until = self.clock.now() + 30
        while not (rest := self.are_at_rest()) and self.clock.now() < until:
            self.clock.sleep(0.01)
        return rest


def pieces_of(folder: Path) -> list[LineSweep]:
    run = RunFolder.open(folder)
    return [piece for k in sorted(run.records) if isinstance(piece := run.piece(k), LineSweep)]


def same(a: list[LineSweep], b: list[LineSweep]) -> bool:
    return len(a) == len(b) and all(
        np.array_equal(x.ranges_m, y.ranges_m, equal_nan=True) and np.array_equal(x.intensity, y.intensity)
        and np.array_equal(x.pan_rad, y.pan_rad)
        for x, y in zip(a, b, strict=True)
    )  # fmt: skip


def recorded_pieces(fields: Mapping[str, Any], folder: Path) -> list[LineSweep | ScanPiece]:
    """Run a plan, given as the content of `plan.json`, on the devices that it names; return its pieces in order."""
    plan, faults = plan_from_fields(fields), list[str]()

    def note(event: object) -> None:
        if isinstance(event, Paused):
            faults.append(event.reason)
            run.stop()  # it would wait for ever

    with (
        closing(RunWriter.begin(folder, plan)) as writer,
        connected(plan, ports=partial(Ports, guarded=False)) as found,
    ):
        run = found.run(plan, writer, note)
        assert run.go(), faults
    recorded = RunFolder.open(folder)
    return [recorded.piece(k) for k in sorted(recorded.records)]
