"""The blocks of pixels that an automatic registration compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, read_only

_BLOCK_ARRAYS: dict[str, tuple[int, ...]] = {
    "uv": (2,), "offset_px": (2,), "information": (2, 2), "correlation": (), "agrees": (),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ComparedBlocks:
    """The B blocks of pixels that an automatic registration compared, at its pose: where each would move, and how much.

    To first order, the refinement minimises the sum of e^T `information` e over the blocks, e = `offset_px` - J x, with
    the derivative J of the pixel by a small change x of the pose: where it ended, the sum of J^T `information`
    `offset_px` is about 0. The information of a block counts it as independent of its neighbours: errors common to
    several blocks, as of a lens, are in the covariance of the pose only.

    Raises:
        ShapeError: if the arrays do not have the same length.
    """

    ids: tuple[str, ...]
    """Names; the match of a block, if it has one, has the same `pick_id`."""
    uv: FloatArray
    """(B, 2) float32, the projection of the block's middle, photo pixels."""
    offset_px: FloatArray
    """(B, 2) float32, the block's own step from there, photo pixels; without limit, also of blocks that disagree."""
    information: FloatArray
    """(B, 2, 2) float32, inverse of the covariance of `offset_px`, 1 / px^2; nearly singular along a straight edge."""
    correlation: FloatArray
    """(B,) float32, of its channels, 0 to 1."""
    agrees: BoolArray
    """(B,) bool: it is an inlier of the matches."""

    def __post_init__(self) -> None:
        count = len(self.ids)
        for name, shape in _BLOCK_ARRAYS.items():
            dtype = np.bool_ if name == "agrees" else np.float32
            array = read_only(getattr(self, name), dtype, (count, *shape), f"`{name}` of the blocks")
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.ids)

    def named(self, prefix: str) -> ComparedBlocks:
        """Return the same blocks with a prefix to their names."""
        return replace(self, ids=tuple(prefix + name for name in self.ids))

    @staticmethod
    def joined(parts: Sequence[ComparedBlocks]) -> ComparedBlocks:
        """Return the blocks of one part or several in one."""
        arrays: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _BLOCK_ARRAYS}
        return ComparedBlocks(ids=tuple(name for part in parts for name in part.ids), **arrays)

    def as_fields(self) -> list[dict[str, Any]]:
        """Return the blocks as JSON-ready values, from which `from_fields` restores every digit."""
        columns = {name: _shortest(getattr(self, name)) for name in _BLOCK_ARRAYS}
        return [{"id": name, **{key: column[k] for key, column in columns.items()}} for k, name in enumerate(self.ids)]

    @staticmethod
    def from_fields(fields: Sequence[Mapping[str, Any]]) -> ComparedBlocks:
        """Return the blocks that `as_fields` describes.

        Raises:
            ShapeError: if they are not such values.
        """
        try:
            arrays: dict[str, Any] = {
                name: np.array([one[name] for one in fields]).reshape(len(fields), *shape)
                for name, shape in _BLOCK_ARRAYS.items()
            }
            if any(array.dtype.kind not in ("b" if name == "agrees" else "iuf") for name, array in arrays.items()):
                raise TypeError("values of another kind")
            return ComparedBlocks(ids=tuple(str(one["id"]) for one in fields), **arrays)
        except (KeyError, TypeError, ValueError) as error:
            raise ShapeError(f"the compared blocks are damaged: {error!r:.60}") from None


def _shortest(values: FloatArray | BoolArray) -> Any:
    """Return an array as lists, its float32 as the shortest numbers that give them back."""
    if values.dtype != np.float32:
        return values.tolist()
    return np.array([float(str(value)) for value in values.reshape(-1)]).reshape(values.shape).tolist()
