"""Arrays that a document refers to by their content: kept once, however many documents share them."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError

_NAME_CHARACTERS = 40


class StoredArrays:
    """Named arrays, frozen, with a name made of their content.

    Args:
        data: as `of` stores them.
        lost: the name of arrays that are missing; they keep their place in the document, and come back with their file.
    """

    __slots__ = ("data", "lost", "name")

    def __init__(self, data: bytes, *, lost: str = "") -> None:
        self.data = data
        self.lost = bool(lost)
        self.name = lost or hashlib.sha256(data).hexdigest()[:_NAME_CHARACTERS]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StoredArrays) and other.name == self.name

    def __hash__(self) -> int:
        return hash(self.name)

    @staticmethod
    def of(arrays: Mapping[str, NDArray[np.generic]]) -> StoredArrays:
        """Return the arrays, stored."""
        buffer = io.BytesIO()
        np.savez(buffer, **{name: np.ascontiguousarray(value) for name, value in sorted(arrays.items())})  # type: ignore[arg-type]
        return StoredArrays(buffer.getvalue())

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays.

        Raises:
            FormatError: if they are missing or damaged.
        """
        if self.lost:
            raise FormatError(f"the stored matches {self.name[:8]} are missing; solve again")
        try:
            with np.load(io.BytesIO(self.data), allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except Exception as error:
            raise FormatError(
                f"the stored matches {self.name[:8]} are damaged ({type(error).__name__}); solve again"
            ) from None
