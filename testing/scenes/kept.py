"""Scenes and results that many tests share: made once in a run, by whichever process needs them first."""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import pickle
import tempfile
from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from hashlib import sha256
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

Arguments = ParamSpec("Arguments")
Made = TypeVar("Made")

_AT_ONCE = 8
"""Results of a function that stay in memory; a scan with its views is some 50 MB."""
_shared: Path | None = None


def share(folder: Path | None) -> None:
    """Keep what is made in files of a folder as well, where the other processes of the run find it."""
    global _shared
    _shared = folder


def kept(make: Callable[Arguments, Made]) -> Callable[Arguments, Made]:
    """Wrap a function of hashable arguments such that equal arguments are computed once; nobody may change the results.

    Two processes that begin at once both compute, and either file is right: nothing waits for anybody.
    """
    signature = inspect.signature(make)

    @lru_cache(maxsize=_AT_ONCE)
    def once(arguments: tuple[tuple[str, Hashable], ...]) -> Made:
        bound = signature.bind_partial()
        bound.arguments.update(arguments)
        if _shared is None:
            return make(*bound.args, **bound.kwargs)
        key = sha256(f"{make.__module__} {arguments}".encode()).hexdigest()[:16]
        path = _shared / f"{make.__name__}-{key}.pickle"
        if path.is_file():
            made: Made = pickle.loads(path.read_bytes())  # a file of this run
            return made
        made = make(*bound.args, **bound.kwargs)
        _write(path, made)
        return made

    @wraps(make)
    def keeping(*arguments: Arguments.args, **named: Arguments.kwargs) -> Made:
        bound = signature.bind(*arguments, **named)
        bound.apply_defaults()
        return once(tuple(bound.arguments.items()))

    return keeping


def kept_folder(name: str, fill: Callable[[Path], object]) -> Path:
    """Return a folder that `fill` has filled, once in a run; nobody may change it, so tests that do work on copies.

    As with `kept`, two processes that begin at once both fill one, and either is right.

    Args:
        name: of the folder, different for different contents.
        fill: is given the path of the folder, which does not exist yet.
    """
    if _shared is None:
        share(Path(tempfile.mkdtemp()))
    assert _shared is not None
    folder = _shared / name
    if not folder.is_dir():
        _shared.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=_shared)) / name
        fill(made)
        with contextlib.suppress(OSError):  # another process was faster
            made.rename(folder)
    return folder


class _Pickler(pickle.Pickler):
    """Arrays that are read-only stay so."""

    def reducer_override(self, value: Any) -> Any:
        if type(value) is not np.ndarray or value.flags.writeable or value.dtype.hasobject:
            return NotImplemented
        order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
        return _array, (value.tobytes(order), value.dtype, value.shape, order)


def _array(data: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], order: str) -> NDArray[Any]:
    return np.frombuffer(data, dtype).reshape(shape, order=order)  # type: ignore[call-overload, no-any-return]


def _write(path: Path, made: object) -> None:
    stream = io.BytesIO()
    _Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(made)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(dir=path.parent)
    with os.fdopen(handle, "wb") as file:
        file.write(stream.getbuffer())
    Path(partial).replace(path)
