"""Limits that readers share with editors: readers cannot use up the room of editors."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Seats:
    """A number of seats, half of which are reserved for editors.

    The read-only link is given away more freely than the other one: its holders may fill their share, and nothing else.
    """

    most: int
    """For all."""

    @property
    def for_readers(self) -> int:
        """Seats that readers may take at most."""
        return max(1, self.most // 2)

    def is_free(self, *, taken: int, by_readers: int, read_only: bool) -> bool:
        """Return whether there is a seat for one more.

        Args:
            taken: seats that are taken, by anyone.
            by_readers: of these, those taken by readers.
            read_only: whether the newcomer may only look.
        """
        return taken < self.most and (not read_only or by_readers < self.for_readers)

    def limit(self, *, read_only: bool) -> int:
        """Return the limit that a newcomer meets who finds no seat."""
        return self.for_readers if read_only else self.most
