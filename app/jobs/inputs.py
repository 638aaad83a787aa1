"""Inputs of a job as they were when it began, and commits that are refused once they have changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document, PhotoEntry
from ladarreg_core.project.edits import edited_photo, require_photo
from ladarreg_core.project.history import Author

from ..session.loader import Loader
from ..session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Matches, Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.settings import Settings
    from ladarreg_core.scan import Scan


@dataclass(frozen=True, slots=True)
class Inputs:
    """The document, scan and photograph that a job works on."""

    document: Document
    """With the scan that the photograph is matched with."""
    entry: PhotoEntry
    scan: Scan
    photo: Photo

    @property
    def clouds(self) -> int:
        """Number of clouds that the scan consists of."""
        return self.document.clouds

    @property
    def settings(self) -> Settings:
        """The settings."""
        return self.document.settings

    @property
    def stated_pose(self) -> Rigid | None:
        """The pose that the scan's file or the operator states for the photograph; None without one."""
        from ladarreg_core.frames import Rigid

        rows = self.entry.stated_pose
        return None if rows is None else Rigid.from_matrix(rows)

    @property
    def note_on_start(self) -> str:
        """A sentence on where a search begins, if that is the stated pose; empty otherwise."""
        if self.entry.stated_pose is None:
            return ""
        stated_by = self.entry.stated_by or "the scan's file"
        return f"The search began at the pose that {stated_by} states for this picture."

    @property
    def picks(self) -> list[Pick]:
        """The enabled picks."""
        return [pick.as_pick() for pick in self.entry.picks if pick.on]

    def matches(self) -> Matches:
        """Return the input of the solvers.

        Raises:
            OptionError: if there are no usable matches.
        """
        from ladarreg_core.picks.measure import matches_from_picks
        from ladarreg_core.project.results import pose_of

        if not self.picks:
            count = len(self.entry.picks)
            if count == 1:
                raise OptionError("the only match is disabled; enable it in the match table")
            if count:
                raise OptionError(f"all {count} matches are disabled; enable some in the match table")
            raise OptionError("there are no matches; draw some, or match corners")
        pose = self.entry.pose
        found, _ = matches_from_picks(
            self.scan,
            self.picks,
            camera=self.photo.camera,
            lines=self.settings.lines,
            samples_per_line=self.settings.samples_per_line,
            pose=None if pose is None else pose_of(pose),
        )
        if not len(found):
            raise OptionError(
                "no match lies where the scan has a range; draw matches on measured cells (see the display Range)"
            )
        return found


class Workspace:
    """Provides jobs with their inputs and commits their results.

    Args:
        session: the session.
        loader: its loader.
    """

    def __init__(self, session: Session, loader: Loader) -> None:
        self.session = session
        self.loader = loader

    def inputs(self, photo_id: object) -> Inputs:
        """Return the present inputs of a job on a photograph.

        Raises:
            LadarregError: if the scan is missing, or the photograph has no camera.
        """
        document = self.session.document
        entry = require_photo(document, photo_id)
        beside = document.beside(entry)
        scan = self.loader.scan(beside)
        if scan is None:
            raise OptionError("there is no scan; open one")
        return Inputs(beside, entry, scan, self.loader.photo(entry))

    def commit(
        self,
        inputs: Inputs,
        label: str,
        edit: Callable[[PhotoEntry], PhotoEntry],
        *,
        author: Author,
        of_picks: bool = False,
        automatic: bool = False,
    ) -> None:
        """Commit a job's result if its inputs have not changed.

        Args:
            inputs: the inputs of the job.
            label: description for the history.
            edit: edit of the photograph.
            author: the client.
            of_picks: whether the picks were among the inputs.
            automatic: whether nobody asked for the job, see `Session.commit`.

        Raises:
            OptionError: if the inputs have changed.
        """

        def apply(document: Document) -> Document:
            now = require_photo(document, inputs.entry.id)
            was = inputs.entry
            same = (
                document.beside(now).scan == inputs.document.scan
                and now.source == was.source
                and now.camera == was.camera
            )
            if not same or (of_picks and now.picks != was.picks):
                what = "matches" if same else "scan or the photograph"
                raise OptionError(f"the {what} changed while the job ran, so its result was discarded; run it again")
            return edited_photo(document, was.id, edit)

        self.session.commit(label, apply, author=author, automatic=automatic)
