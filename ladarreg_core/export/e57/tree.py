"""Copies of E57 nodes, value by value: what a new file takes over from another without a change.

libe57 writes, and cannot add to a file that exists, so that a file with more in it is a new file. The nodes of the old
one, which our own reader parsed, are copied with their types, bounds, precisions and scales; the records of compressed
vectors and the bytes of blobs follow in chunks, raw, so that scaled integers keep their whole numbers and
floating-point numbers their bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DependencyError, ExportError, FormatError
from ladarreg_core.formats.e57.records import E57Field, fields_of, read_records
from ladarreg_core.formats.e57.tree import E57File, E57Node, whole_number
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.storage.atomic_write import cannot_write

RECORDS_AT_ONCE = 131_072
_BLOB_BYTES_AT_ONCE = 1 << 22
_SINGLE_BOUNDS = float(np.finfo(np.float32).min), float(np.finfo(np.float32).max)
_DOUBLE_BOUNDS = float(np.finfo(np.float64).min), float(np.finfo(np.float64).max)

Buffers = dict[str, NDArray[Any]]
"""Values of some records by the path of their field, raw: int64, float32 or float64."""
Fill = Callable[[int, Buffers], None]
"""Changes the values of the first so many records."""
Made = Callable[[Any], Any]
"""Copies a node into the new file."""


def library() -> Any:
    """Return the bindings of libe57.

    Raises:
        DependencyError: if they are not installed.
    """
    try:
        from pye57 import libe57
    except ImportError as error:
        raise DependencyError(
            "writing E57 needs the package pye57, which is not installed: pip install pye57"
        ) from error
    return libe57


@contextmanager
def new_e57(path: Path) -> Iterator[Any]:
    """Create an E57 file; it is removed again if anything goes wrong.

    Raises:
        ExportError: if it cannot be written.
    """
    libe57 = library()
    try:
        file = libe57.ImageFile(str(path), "w")
        try:
            yield file
            file.close()
        except BaseException:
            file.cancel()
            raise
    except libe57.E57Exception as error:
        path.unlink(missing_ok=True)
        text = str(error).strip()
        said = one_line(text.partition("\n")[0].partition(" (Error")[0], 120)
        if f"fileName={path}" in text:
            raise ExportError(
                f"the E57 cannot be written: {said}; give a writable folder with enough free space"
            ) from error
        raise ExportError(
            f"the E57 cannot be copied: {said}; export the scan again from the program that made it"
        ) from error
    except OSError as error:
        path.unlink(missing_ok=True)
        raise cannot_write(path.name, error) from error


class E57Copy:
    """Copies nodes of a file that was parsed into a new one.

    Args:
        file: the new file.
        report: receives the numbers of records that were copied; may raise `Cancelled`.
        source: the file that is copied; what claims more than it can hold is damaged.
    """

    def __init__(self, file: Any, report: Callable[[int], None], source: E57File) -> None:
        self._file, self._report, self._source, self._e57 = file, report, source, library()
        self._blob_bytes_left = source.pages.file_bytes
        self._later: list[Callable[[], None]] = []

    def extensions(self) -> None:
        """Declare the namespaces of the source."""
        for prefix, address in self._source.extensions.items():
            self._file.extensionsAdd(prefix, address)

    def node(self, node: E57Node) -> Any:
        """Return a copy that is not attached yet; its records and bytes are copied by `finish`."""
        e57, file = self._e57, self._file
        match node.kind:
            case "Structure":
                return self.structure(node, {})
            case "Vector":
                return self.vector(node)
            case "CompressedVector":
                return self.records(node)
            case "Integer":
                return e57.IntegerNode(file, whole_number(node.text.strip(), node.name), *_bounds(node))
            case "ScaledInteger":
                scaled = node.real("scale", 1.0), node.real("offset", 0.0)
                value = whole_number(node.text.strip(), node.name)
                return e57.ScaledIntegerNode(file, value, *_bounds(node), *scaled)
            case "Float":
                single = node.attributes.get("precision") == "single"
                precision = e57.E57_SINGLE if single else e57.E57_DOUBLE
                low, high = _SINGLE_BOUNDS if single else _DOUBLE_BOUNDS
                bounds = node.real("minimum", low), node.real("maximum", high)
                return e57.FloatNode(file, node.number(), precision, *bounds)
            case "String":
                return e57.StringNode(file, node.text)
            case "Blob":
                return self._blob(node)
        raise FormatError(
            f"the E57 cannot be copied: its element {one_line(node.name, 40)} is of the type "
            f"{one_line(node.kind, 30)!r}; it is damaged: copy it again"
        )

    def structure(self, node: E57Node, changed: dict[str, Made | None]) -> Any:
        """Return a copy of a structure, in which some children are made by functions, or left out (None)."""
        made = self._e57.StructureNode(self._file)
        for child in node.children:
            make: Made | None = changed.get(child.name, self.node)
            if make is not None:
                made.set(child.name, make(child))
        return made

    def vector(self, node: E57Node, changed: dict[int, Made] | None = None) -> Any:
        """Return a copy of a vector, in which some children are made by functions and others may be added."""
        mixed = changed is not None or node.attributes.get("allowHeterogeneousChildren") == "1"
        made = self._e57.VectorNode(self._file, mixed)
        for index, child in enumerate(node.children):
            make: Made = (changed or {}).get(index, self.node)
            made.append(make(child))
        return made

    def records(
        self,
        node: E57Node,
        change: Callable[[Any], None] | None = None,
        fill: Fill | None = None,
        dropped: Sequence[str] = (),
    ) -> Any:
        """Return a copy of a compressed vector.

        Args:
            node: the compressed vector.
            change: adds fields to the copy of its prototype.
            fill: receives the number of records and their values, and sets those that are not copied.
            dropped: fields of the prototype that are left out of the copy; `change` may define them anew.
        """
        e57, prototype = self._e57, node.child("prototype")
        if prototype is None:
            raise FormatError(f"the records {one_line(node.name, 40)} of the E57 have no fields; it is damaged")
        if node.whole("recordCount") > 8 * self._source.pages.file_bytes:
            raise FormatError("the records of the E57 are more than the file has bits; it is damaged")
        made_prototype = self.structure(prototype, dict.fromkeys(dropped))
        if change is not None:
            change(made_prototype)
        made = e57.CompressedVectorNode(self._file, made_prototype, e57.VectorNode(self._file, True))
        self._later.append(lambda: self._run(node, made, made_prototype, fill, dropped))
        return made

    def finish(self) -> None:
        """Copy the records and bytes of all nodes, which are attached by now."""
        for copy in self._later:
            copy()
        self._later.clear()

    def _run(self, node: E57Node, made: Any, made_prototype: Any, fill: Fill | None, dropped: Sequence[str]) -> None:
        size = max(1, min(RECORDS_AT_ONCE, node.whole("recordCount")))
        # What is only copied goes from the reader to the writer in the same array.
        values = raw_buffers(fields_of(node), size)
        kept = {path: values[path] for path in values if path not in dropped}
        changed = record_buffers(made_prototype, size) | kept
        written = {path: changed[path] for path, _ in leaves(made_prototype)}
        with record_writer(self._file, made, written) as write:
            for some in read_records(self._source.pages, node, values, "what is copied", scaled=False):
                if fill is not None:
                    fill(some, changed)
                write(some)
                self._report(some)

    def _blob(self, node: E57Node) -> Any:
        length = node.whole("length")
        self._blob_bytes_left -= length
        if length < 0 or self._blob_bytes_left < 0:
            raise FormatError("the pictures of the E57 claim more bytes than the file has; it is damaged")
        made = self._e57.BlobNode(self._file, length)
        self._later.append(lambda: self._bytes(node, length, made))
        return made

    def _bytes(self, node: E57Node, length: int, made: Any) -> None:
        data = self._source.blob(node.whole("fileOffset"), length)
        for first in range(0, length, _BLOB_BYTES_AT_ONCE):
            part = data[first : first + _BLOB_BYTES_AT_ONCE].copy()
            made.write(part, first, len(part))
            self._report(0)


def _bounds(node: E57Node) -> tuple[int, int]:
    return node.whole("minimum", -(2**63)), node.whole("maximum", 2**63 - 1)


def leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the fields of a new prototype by their paths."""
    for index in range(node.childCount()):
        child = node[index]
        name = f"{path}{child.elementName()}"
        if isinstance(child, library().StructureNode):
            yield from leaves(child, f"{name}/")
        else:
            yield name, child


def raw_buffers(fields: Iterable[E57Field], size: int) -> Buffers:
    """Return arrays (size,) for the raw values of fields of a source.

    Raises:
        ExportError: if a field is neither a whole nor a floating-point number.
    """
    codes = {"integer": "q", "scaled": "q", "single": "f", "double": "d"}
    for field in fields:
        if field.stored not in codes:
            raise _not_a_number(field.name)
    return {field.name: np.zeros(size, codes[field.stored]) for field in fields}


def _not_a_number(path: str) -> ExportError:
    return ExportError(
        f"the field {one_line(path, 40)} of the E57's points is not a number, and only numbers can be copied; export "
        "the scan without it"
    )


def record_buffers(prototype: Any, size: int) -> Buffers:
    """Return arrays (size,) for the raw values of records that are written.

    Raises:
        ExportError: if a field is neither a whole nor a floating-point number.
    """
    e57 = library()
    buffers: Buffers = {}
    for path, node in leaves(prototype):
        if isinstance(node, (e57.IntegerNode, e57.ScaledIntegerNode)):
            buffers[path] = np.zeros(size, "q")
        elif isinstance(node, e57.FloatNode):
            buffers[path] = np.zeros(size, "f" if node.precision() == e57.E57_SINGLE else "d")
        else:
            raise _not_a_number(path)
    return buffers


@contextmanager
def record_writer(file: Any, made: Any, buffers: Buffers) -> Iterator[Callable[[int], None]]:
    """Open the records of an attached compressed vector; the function writes the first values of the buffers."""
    writer = made.writer(_bound(file, buffers))
    try:
        yield writer.write
    finally:
        writer.close()


def _bound(file: Any, buffers: Buffers) -> Any:
    e57 = library()
    bound = e57.VectorSourceDestBuffer()
    for path, values in buffers.items():
        bound.append(e57.SourceDestBuffer(file, path, values, len(values), True, False))
    return bound
