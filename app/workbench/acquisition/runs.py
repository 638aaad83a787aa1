"""The runs that a project's folder holds: what each has, also after the workbench was started again."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.storage.atomic_write import replaced_file, write_bytes

if TYPE_CHECKING:
    from ladarreg_core.acquisition.plan import Plan

    from ...slices.several import AcquiredRun

log = logging.getLogger(__name__)
PANORAMA = "scan.npz"
DRAFT = "draft.json"
_MAX_BYTES_OF_A_PLAN = 100_000


class Runs:
    """The runs in a folder, each in a folder of its own.

    Args:
        folder: the folder; it need not be there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.slice: list[AcquiredRun] = []
        """What pages receive about each run, the latest first."""
        self.refresh()

    def path(self, name: str) -> Path:
        """Return the folder of a run, there or not.

        Raises:
            OptionError: if no run can have that name.
        """
        if Path(name).name != name or name in ("", ".", ".."):
            raise OptionError("the run has no such name")
        return self._folder / name

    def new_name(self) -> str:
        """Return a name that no run has."""
        taken = {path.name for path in self._folder.iterdir()} if self._folder.is_dir() else set()
        number = 1
        while f"run-{number:03d}" in taken:
            number += 1
        return f"run-{number:03d}"

    @property
    def draft(self) -> dict[str, Any] | None:
        """The plan that was being edited last, right or not; None if there is none."""
        try:
            found = json.loads((self._folder / DRAFT).read_bytes())
        except (OSError, ValueError):
            return None  # nobody has edited one, or something else has damaged it: editing begins anew
        return found if isinstance(found, dict) else None

    def keep_draft(self, fields: Mapping[str, Any]) -> None:
        """Keep a plan that is being edited, right or not.

        Raises:
            OptionError: if it is too large for a plan.
            ExportError: if it cannot be written.
        """
        data = json.dumps(fields, indent=1).encode()
        if len(data) > _MAX_BYTES_OF_A_PLAN:
            raise OptionError(f"the plan has {len(data):,} bytes; a plan has at most {_MAX_BYTES_OF_A_PLAN:,}")
        self._folder.mkdir(parents=True, exist_ok=True)
        with replaced_file(self._folder / DRAFT) as new:
            write_bytes(new, data)

    def refresh(self) -> None:
        """Look at the folder again."""
        from ladarreg_core.acquisition.runs.run_folder import summary

        found: list[AcquiredRun] = []
        for path in sorted(self._folder.iterdir(), reverse=True) if self._folder.is_dir() else []:
            try:
                run = summary(path)
            except LadarregError as error:
                log.info("no run: %s", error)
                continue
            complete = run.done == run.total and (path / PANORAMA).is_file()
            found.append({
                "name": path.name, "done": run.done, "total": run.total, "complete": complete,
                "photos": len(run.photos),
            })  # fmt: skip
        self.slice = found

    def plan(self, name: str) -> Plan:
        """Return the plan of a run.

        Raises:
            LadarregError: if there is no such run, or its plan is damaged.
        """
        from ladarreg_core.acquisition.runs.run_folder import summary

        return summary(self.path(name)).plan

    def panorama(self, name: str) -> Path:
        """Return the file of a run's panorama.

        Raises:
            OptionError: if the run has not been finished.
        """
        path = self.path(name) / PANORAMA
        if not any(run["name"] == name and run["complete"] for run in self.slice) or not path.is_file():
            raise OptionError("that run has not been finished; run its plan to the end first")
        return path

    def photos(self, name: str) -> list[tuple[Path, str]]:
        """Return the photographs of a run with names that say where the unit stood.

        Raises:
            LadarregError: if there is no such run, or it has none.
        """
        from ladarreg_core.acquisition.runs.run_folder import summary

        found = summary(self.path(name)).photos
        if not found:
            raise OptionError("that run has no photographs; give its plan a camera")
        return [
            (path, f"{name} pan {at[0]:.0f} tilt {at[1]:.0f} {path.name}") for path, at in found
        ]  # fmt: skip
