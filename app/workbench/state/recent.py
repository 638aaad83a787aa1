"""The projects that were opened lately, with a picture of each, in the folder of the user's data."""

from __future__ import annotations

import json
import logging
import os
import secrets
import threading
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any

from ladarreg_core.errors import LadarregError
from ladarreg_core.project.storage.folder import is_project
from ladarreg_core.project.summary import read_summary

log = logging.getLogger(__name__)
_LIST, _PICTURES = "recent.json", "thumbnails"
_MOST = 40


def project_id(folder: Path) -> str:
    """Return the id of a project for pages; the same for the same folder."""
    return blake2b(os.fsencode(folder), digest_size=8).hexdigest()


class RecentProjects:
    """The list; a file that cannot be written only costs the list.

    Args:
        data: folder of the user's data.
    """

    def __init__(self, data: Path) -> None:
        self._data = data
        self._lock = threading.Lock()

    def remember(self, project: Path) -> None:
        """Put a project first."""
        with self._lock:
            self._write([project, *(path for path in self._paths() if path != project)])

    def forget(self, wanted: str) -> None:
        """Remove a project from the list; its folder stays."""
        with self._lock:
            self._write([path for path in self._paths() if project_id(path) != wanted])
            with suppress(OSError):
                self._picture(wanted).unlink(missing_ok=True)

    def find(self, wanted: object) -> Path | None:
        """Return the folder of a project of the list; None if it is not in it."""
        return next((path for path in self._paths() if project_id(path) == wanted), None)

    def listed(self, current: Path, name: str, *, with_paths: bool) -> list[dict[str, Any]]:
        """Return the list for pages, the latest first.

        Args:
            current: folder of the open project.
            name: its present name, which its folder may not have yet: saving takes a moment.
            with_paths: whether pages may see where the folders lie, beside their names.
        """
        entries = [self._entry(path, is_current=path == current, with_path=with_paths) for path in self._paths()]
        return [{**entry, "name": name} if entry["current"] else entry for entry in entries]

    def picture(self, wanted: str) -> bytes | None:
        """Return the picture of a project, JPEG; None if there is none."""
        if not (len(wanted) == 16 and set(wanted) <= set("0123456789abcdef")):
            return None
        try:
            return self._picture(wanted).read_bytes()
        except OSError:
            return None

    def save_picture(self, project: Path, jpeg: bytes) -> None:
        """Keep the picture of a project."""
        self._replace(self._picture(project_id(project)), jpeg)

    def _entry(self, path: Path, *, is_current: bool, with_path: bool) -> dict[str, Any]:
        key = project_id(path)
        folder = str(path) if with_path else path.name
        found = {"id": key, "name": path.name, "folder": folder, "state": "", "edited": "", "missing": False}
        found |= {"current": is_current, "picture": self._picture(key).is_file()}
        try:
            summary = read_summary(path)
        except LadarregError as error:
            missing = False
            with suppress(LadarregError):
                missing = not is_project(path)
            said = "its folder is missing: it was moved or deleted, or its disk is not there" if missing else str(error)
            return found | {"missing": missing, "state": said}
        return found | {"name": summary.name, "state": summary.describe(), "edited": summary.edited}

    def _picture(self, key: str) -> Path:
        return self._data / _PICTURES / f"{key}.jpg"

    def _paths(self) -> list[Path]:
        try:
            entries = json.loads((self._data / _LIST).read_text(encoding="utf-8"))["projects"]
            return [Path(path) for path in entries if isinstance(path, str) and os.path.isabs(path)]
        except FileNotFoundError:
            return self._projects_of_earlier_versions()
        except (OSError, ValueError, KeyError, TypeError):
            return []

    def _projects_of_earlier_versions(self) -> list[Path]:
        """Return the projects in the user's data, which earlier versions did not list, the latest first."""
        found = []
        for path in (self._data / "projects").glob("*"):
            with suppress(LadarregError):
                summary = read_summary(path)
                found += [] if summary.is_empty else [(summary.edited, path)]
        return [path for _, path in sorted(found, reverse=True)]

    def _write(self, paths: list[Path]) -> None:
        text = json.dumps({"projects": [str(path) for path in paths[:_MOST]]}, indent=1)
        self._replace(self._data / _LIST, text.encode())

    def _replace(self, target: Path, data: bytes) -> None:
        aside = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            aside.write_bytes(data)
            aside.replace(target)
        except (OSError, UnicodeEncodeError) as error:
            log.info("%s cannot be written: %s", target, error)
            with suppress(OSError):
                aside.unlink(missing_ok=True)
