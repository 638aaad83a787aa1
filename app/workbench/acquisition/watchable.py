"""What a plan from a page may watch: the folders, video devices and UDP ports that the operator of the server named.

Whether anything else exists is not answered, so that no page can search the computer for folders.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ladarreg_core.acquisition.plan import PlanFault


@dataclass(frozen=True, slots=True)
class Watchable:
    """Folders and devices that plans may name, beside simulated ones."""

    folders: tuple[Path, ...] = ()
    """Folders; those below them count, too."""
    devices: tuple[int, ...] = ()
    """Numbers of video devices."""
    udp_ports: tuple[int, ...] = ()
    """Ports to which lidars send."""

    def beside(self, folder: Path | None) -> Watchable:
        """Return the same with one more folder, if it is one."""
        return self if folder is None else replace(self, folders=(*self.folders, folder))

    def faults(self, fields: Mapping[str, Any]) -> list[PlanFault]:
        """Return what a plan names beyond them, right or not in all else."""
        from ladarreg_core.acquisition.plan import PlanFault
        from ladarreg_core.acquisition.twin_address import is_twin

        found = []
        for part in ("scanner", "camera"):
            stated = fields.get(part)
            if not isinstance(stated, Mapping):
                continue
            folder = stated.get("folder")
            if isinstance(folder, str) and not is_twin(folder) and not self._offers(folder):
                found.append(
                    PlanFault(
                        f"{part}.folder",
                        f"'folder' of '{part}' is not one that this workbench was started with; restart it with "
                        "--watch and the folder, or run the plan by `ladarreg acquire`",
                    )
                )
            if "device" in stated and stated["device"] not in self.devices:
                found.append(
                    PlanFault(
                        f"{part}.device",
                        f"'device' of '{part}' is not one that this workbench was started with; restart it with "
                        "--video-device and its number, or run the plan by `ladarreg acquire`",
                    )
                )
        return found + self._lidar_faults(fields.get("scanner"))

    def _lidar_faults(self, stated: Any) -> list[PlanFault]:
        from ladarreg_core.acquisition.plan import PlanFault
        from ladarreg_core.acquisition.twin_address import is_twin

        if not isinstance(stated, Mapping):
            return []
        found = []
        host, file = stated.get("host"), stated.get("sensor_file")
        is_simulated = isinstance(host, str) and is_twin(host)
        if stated.get("kind") == "packets" and not is_simulated and stated.get("udp_port") not in self.udp_ports:
            found.append(
                PlanFault(
                    "scanner.udp_port",
                    "'udp_port' of 'scanner' is not one that this workbench was started with; restart it with "
                    "--udp-port and its number, or run the plan by `ladarreg acquire`",
                )
            )
        if isinstance(file, str) and file.strip() and not self._offers(file):
            found.append(
                PlanFault(
                    "scanner.sensor_file",
                    "'sensor_file' of 'scanner' is not in a folder that this workbench was started with; restart it "
                    "with --watch and the folder, or run the plan by `ladarreg acquire`",
                )
            )
        return found

    def _offers(self, folder: str) -> bool:
        try:
            asked = Path(folder).expanduser().resolve()
        except (OSError, RuntimeError, ValueError):
            return False
        return any(asked.is_relative_to(offered.resolve()) for offered in self.folders)


SIMULATED_ONLY = Watchable()
"""Nothing but simulated devices."""
