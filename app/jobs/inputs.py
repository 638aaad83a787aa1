"""What every job needs: its inputs as they stood when it began, and a commit that is refused if they have changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document, PhotoEntry
from ladarreg_core.project.edits import edited_photo, the_photo

from ..session.loader import Workroom
from ..session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.matches import Matches, Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.settings import Settings
    from ladarreg_core.scan import Scan


@dataclass(frozen=True, slots=True)
class Inputs:
    """A scan, a photograph and what was drawn on it when a job began."""

    document: Document
    entry: PhotoEntry
    scan: Scan
    photo: Photo

    @property
    def settings(self) -> Settings:
        """The thresholds."""
        return self.document.settings

    @property
    def picks(self) -> list[Pick]:
        """Those that are switched on."""
        return [pick.as_pick() for pick in self.entry.picks if pick.on]

    def matches(self) -> Matches:
        """Return what a solver eats.

        Raises:
            OptionError: if nothing is drawn.
        """
        from ladarreg_core.picks.measure import matches_from_picks
        from ladarreg_core.project.results import pose_of

        if not self.picks:
            drawn = len(self.entry.picks)
            if drawn == 1:
                raise OptionError("the only match is switched off; switch it on in the table of matches")
            if drawn:
                raise OptionError(f"all {drawn} matches are switched off; switch some on in the table of matches")
            raise OptionError("there are no matches; draw some, or let corners be matched")
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
                "no match lies where the scan has a range; draw where the laser saw something: the scan shown as Range "
                "tells where"
            )
        return found


class Bench:
    """Where jobs get their inputs and leave their results."""

    def __init__(self, session: Session, room: Workroom) -> None:
        self.session = session
        self.room = room

    def inputs(self, photo_id: object) -> Inputs:
        """Return a job's inputs.

        Raises:
            LadarregError: if the scan is missing, or the photograph has no camera.
        """
        document = self.session.document
        entry = the_photo(document, photo_id)
        scan = self.room.scan(document)
        if scan is None:
            raise OptionError("there is no scan; open one")
        return Inputs(document, entry, scan, self.room.photo(entry))

    def commit(
        self,
        inputs: Inputs,
        label: str,
        edit: Callable[[PhotoEntry], PhotoEntry],
        *,
        author: str,
        of_picks: bool = False,
    ) -> None:
        """Commit a job's result, if its inputs are still the same.

        Args:
            inputs: what it began with.
            label: for the history.
            edit: of the photograph.
            author: who asked for it.
            of_picks: whether the picks were among its inputs.

        Raises:
            OptionError: if they are not.
        """

        def apply(document: Document) -> Document:
            now = the_photo(document, inputs.entry.id)
            was = inputs.entry
            same = document.scan == inputs.document.scan and now.source == was.source and now.camera == was.camera
            if not same or (of_picks and now.picks != was.picks):
                what = "matches" if same else "scan or the photograph"
                raise OptionError(f"the {what} changed while this ran, so that its result is left out; run it again")
            return edited_photo(document, was.id, edit)

        self.session.commit(label, apply, author=author)
