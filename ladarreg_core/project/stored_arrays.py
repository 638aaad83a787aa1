"""Content-addressed arrays: stored once, however many documents share them."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError

_NAME_CHARACTERS = 40


class StoredArrays:
    """Frozen set of named arrays, identified by a hash of their content.

    Args:
        data: serialised arrays, as written by `of`.
        lost: name of missing arrays; the document keeps referring to them, and they return with their file.
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
        """Serialise arrays."""
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
