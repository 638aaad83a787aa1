"""The commands of a page that concern projects as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Protocol

from msgspec import Meta

from ladarreg_core.errors import OptionError

from .command import Command, FileIds, Reply, commands_in

if TYPE_CHECKING:
    from ..state.clients import Client

_MAX_LETTERS, _MAX_PATH, _MAX_WORDS = 80, 4000, 200
_NO_FOLDER = "no folder is given; enter the path of a project's folder"
Wanted = Annotated[str, Meta(title="no project is given; choose one of the list")]


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

    def listed_jobs(self, outcome: str | None, words: str) -> Reply:
        """Return the jobs of the batch."""

    def open_job(self, wanted: str, client: Client, *, sure: bool) -> Reply:
        """Open a job of the batch as a project."""


class ProjectCommand(Command, frozen=True):
    """A command on projects as a whole."""

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Execute it and return the fields of the reply; raises `LadarregError`."""
        raise NotImplementedError


class ListProjects(ProjectCommand, frozen=True):
    """the recent projects; `anywhere`: whether any folder may be opened; `batch`: whether there is one to list"""

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "projects: [{id, name, folder, state, edited, missing, current, picture}], anywhere, batch"

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Return them."""
        return projects.listed()


class NewProject(ProjectCommand, frozen=True):
    """begins a project, and opens waiting files in it"""

    replies: ClassVar[str] = "opened | asks: [sentence, ..]"
    name: Annotated[str, Meta(title=f"the name of a project has at most {_MAX_LETTERS} letters")] | None = None
    files: FileIds | None = None
    sure: bool = False

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Begin it."""
        name = self.name or ""
        if len(name.strip()) > _MAX_LETTERS or not name.isprintable():
            raise OptionError(f"the name of a project has at most {_MAX_LETTERS} letters")
        return projects.new(name.strip(), self.files or (), client, sure=self.sure)


class OpenProject(ProjectCommand, frozen=True):
    """opens a project of the list, `wanted`, or of a folder of the server's machine; of a batch, its list"""

    replies: ClassVar[str] = "opened | asks | batch"
    wanted: Wanted | None = None
    folder: Annotated[str, Meta(max_length=_MAX_PATH, title=_NO_FOLDER)] | None = None
    sure: bool = False

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Open it."""
        if self.wanted is not None:
            folder = projects.find(self.wanted)
            if folder is None:
                raise OptionError("this project is not in the list any more; reload the page")
            return projects.open(folder, client, sure=self.sure)
        path = (self.folder or "").strip()
        if not path or "\0" in path:
            raise OptionError(_NO_FOLDER)
        return projects.open_path(path, client, sure=self.sure)


class OpenSample(ProjectCommand, frozen=True):
    """opens the sample, and registers it unless there is work on it"""

    replies: ClassVar[str] = "opened | asks"
    sure: bool = False

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Open it."""
        return projects.open_sample(client, sure=self.sure)


class DuplicateProject(ProjectCommand, frozen=True):
    """copies a project with its history and the files in its folder"""

    replies: ClassVar[str] = "duplicate: ID"
    wanted: Wanted

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Copy it."""
        return projects.duplicate(self.wanted)


class ForgetProject(ProjectCommand, frozen=True):
    """removes a project from the list; its folder stays"""

    wanted: Wanted

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Remove it."""
        return projects.forget(self.wanted)


class ListJobs(ProjectCommand, frozen=True):
    """the jobs of the batch whose folder the workbench was started on, or which was opened, what failed first"""

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = (
        "name, counts: {outcome: n}, runs, matching, jobs: [{id, kind, outcome, verdict, reason, sigma, picture, "
        "project}]"
    )
    outcome: Literal["failed", "refused", "waiting", "accepted"] | None = None
    words: Annotated[str, Meta(max_length=_MAX_WORDS, title="search for at most 200 characters")] = ""

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Return them."""
        return projects.listed_jobs(self.outcome, self.words)


class OpenJob(ProjectCommand, frozen=True):
    """opens a job of the batch as a project, with the poses that it found to begin with"""

    replies: ClassVar[str] = "opened | asks"
    wanted: Annotated[str, Meta(max_length=_MAX_WORDS, title="no job is given; choose one of the list")]
    sure: bool = False

    def execute(self, projects: Projects, client: Client) -> Reply:
        """Open it."""
        return projects.open_job(self.wanted, client, sure=self.sure)


PROJECT_COMMANDS: dict[str, type[ProjectCommand]] = commands_in(globals(), ProjectCommand)
"""The commands on projects, by name."""
