"""The commands of a page that concern projects as a whole."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from ladarreg_core.errors import OptionError

from .clients import Client
from .commands import file_ids

Fields = Mapping[str, Any]
Reply = dict[str, Any]
_MAX_LETTERS, _LONGEST_PATH = 80, 4000


class Projects(Protocol):
    """The parts of the desk that commands use."""

    def listed(self) -> Reply:
        """Return the recent projects."""

    def new(self, name: str, files: Sequence[str], client: Client, *, sure: bool) -> Reply:
        """Begin a project."""

    def open(self, folder: Path, client: Client, *, sure: bool) -> Reply:
        """Open a project."""

    def open_path(self, text: str, client: Client, *, sure: bool) -> Reply:
        """Open a project by the path of its folder."""

    def open_sample(self, client: Client, *, sure: bool) -> Reply:
        """Open the sample."""

    def duplicate(self, wanted: str) -> Reply:
        """Copy a project."""

    def forget(self, wanted: str) -> Reply:
        """Remove a project from the list."""

    def find(self, wanted: object) -> Path | None:
        """Return the folder of a project of the list."""


ProjectCommand = Callable[[Any, Client, Fields], Reply]


def list_projects(projects: Projects, client: Client, fields: Fields) -> Reply:
    """List the recent projects."""
    return projects.listed()


def new_project(projects: Projects, client: Client, fields: Fields) -> Reply:
    """Begin a project."""
    name = fields.get("name") or ""
    if not isinstance(name, str) or len(name.strip()) > _MAX_LETTERS or not name.isprintable():
        raise OptionError(f"the name of a project has at most {_MAX_LETTERS} letters")
    files = file_ids(fields) if "files" in fields else []
    return projects.new(name.strip(), files, client, sure=fields.get("sure") is True)


def open_project(projects: Projects, client: Client, fields: Fields) -> Reply:
    """Open a project of the list, or one by its folder."""
    sure = fields.get("sure") is True
    wanted, path = fields.get("wanted"), fields.get("folder")
    if isinstance(wanted, str):
        folder = projects.find(wanted)
        if folder is None:
            raise OptionError("this project is not in the list any more; reload the page")
        return projects.open(folder, client, sure=sure)
    if not isinstance(path, str) or not path.strip() or len(path) > _LONGEST_PATH or "\0" in path:
        raise OptionError("no folder is given; enter the path of a project's folder")
    return projects.open_path(path.strip(), client, sure=sure)


def open_sample(projects: Projects, client: Client, fields: Fields) -> Reply:
    """Open the sample."""
    return projects.open_sample(client, sure=fields.get("sure") is True)


def duplicate_project(projects: Projects, client: Client, fields: Fields) -> Reply:
    """Copy a project of the list."""
    return projects.duplicate(_wanted(fields))


def forget_project(projects: Projects, client: Client, fields: Fields) -> Reply:
    """Remove a project from the list; its folder stays."""
    return projects.forget(_wanted(fields))


PROJECT_COMMANDS: dict[str, ProjectCommand] = {
    command.__name__: command
    for command in (list_projects, new_project, open_project, open_sample, duplicate_project, forget_project)
}

LOOKING_AT_PROJECTS = frozenset({"list_projects"})
"""The commands of a read-only client; it is refused all others."""


def _wanted(fields: Fields) -> str:
    wanted = fields.get("wanted")
    if not isinstance(wanted, str):
        raise OptionError("no project is given; choose one of the list")
    return wanted
