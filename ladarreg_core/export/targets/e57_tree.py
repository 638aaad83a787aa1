"""Copies of E57 nodes, value by value: what a new file takes over from another without a change.

libe57 cannot add to a file that exists, so that a file with more in it is a new file. Its nodes are copied with their
types, bounds, precisions and scales; the records of compressed vectors and the bytes of blobs follow in chunks, raw, so
that scaled integers keep their whole numbers and floating-point numbers their bits.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.atomic_write import cannot_write
from ladarreg_core.errors import DependencyError, ExportError, FormatError
from ladarreg_core.formats.untrusted import one_line

RECORDS_AT_ONCE = 131_072
_BLOB_BYTES_AT_ONCE = 1 << 22

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
        if f"fileName={path}" in text:  # pages of the new file are read again while it is written, too
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
    """Copies nodes of a file that is open into a new one.

    Args:
        file: the new file.
        report: receives the numbers of records that were copied; may raise `Cancelled`.
        source_bytes: size of the file that is copied; what claims more than it can hold is damaged.
    """

    def __init__(self, file: Any, report: Callable[[int], None], source_bytes: int) -> None:
        self._file, self._report, self._e57 = file, report, library()
        self._blob_bytes_left, self._most_records = source_bytes, 8 * source_bytes
        self._later: list[Callable[[], None]] = []

    def extensions(self, source: Any) -> None:
        """Declare the namespaces of another file."""
        for index in range(source.extensionsCount()):
            self._file.extensionsAdd(source.extensionsPrefix(index), source.extensionsUri(index))

    def node(self, node: Any) -> Any:
        """Return a copy that is not attached yet; its records and bytes are copied by `finish`."""
        e57, file = self._e57, self._file
        if isinstance(node, e57.StructureNode):
            return self.structure(node, {})
        if isinstance(node, e57.VectorNode):
            return self.vector(node)
        if isinstance(node, e57.CompressedVectorNode):
            return self.records(node)
        if isinstance(node, e57.IntegerNode):
            return e57.IntegerNode(file, node.value(), node.minimum(), node.maximum())
        if isinstance(node, e57.ScaledIntegerNode):
            return e57.ScaledIntegerNode(
                file, node.rawValue(), node.minimum(), node.maximum(), node.scale(), node.offset()
            )
        if isinstance(node, e57.FloatNode):
            return e57.FloatNode(file, node.value(), node.precision(), node.minimum(), node.maximum())
        if isinstance(node, e57.StringNode):
            return e57.StringNode(file, node.value())
        self._blob_bytes_left -= node.byteCount()
        if self._blob_bytes_left < 0:
            raise FormatError("the pictures of the E57 claim more bytes than the file has; it is damaged")
        made = e57.BlobNode(file, node.byteCount())
        self._later.append(lambda: self._bytes(node, made))
        return made

    def structure(self, node: Any, changed: dict[str, Made | None]) -> Any:
        """Return a copy of a structure, in which some children are made by functions, or left out (None)."""
        made = self._e57.StructureNode(self._file)
        for index in range(node.childCount()):
            child = node[index]
            name = child.elementName()
            make = changed.get(name, self.node)
            if make is not None:
                made.set(name, make(child))
        return made

    def vector(self, node: Any, changed: dict[int, Made] | None = None) -> Any:
        """Return a copy of a vector, in which some children are made by functions and others may be added."""
        made = self._e57.VectorNode(self._file, changed is not None or node.allowHeteroChildren())
        for index in range(node.childCount()):
            made.append((changed or {}).get(index, self.node)(node[index]))
        return made

    def records(
        self,
        node: Any,
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
        e57 = self._e57
        if node.childCount() > self._most_records:
            raise FormatError("the records of the E57 are more than the file has bits; it is damaged")
        prototype = e57.StructureNode(node.prototype())
        made_prototype = self.structure(prototype, dict.fromkeys(dropped))
        if change is not None:
            change(made_prototype)
        # The codecs of a file are not asked for: there is only one, and the library crashes where a file has no list.
        made = e57.CompressedVectorNode(self._file, made_prototype, e57.VectorNode(self._file, True))
        self._later.append(lambda: self._run(node, prototype, made, made_prototype, fill, dropped))
        return made

    def finish(self) -> None:
        """Copy the records and bytes of all nodes, which are attached by now."""
        for copy in self._later:
            copy()
        self._later.clear()

    def _run(
        self,
        node: Any,
        prototype: Any,
        made: Any,
        made_prototype: Any,
        fill: Fill | None,
        dropped: Sequence[str],
    ) -> None:
        count = node.childCount()
        size = max(1, min(RECORDS_AT_ONCE, count))
        # What is only copied goes from the reader to the writer in the same array.
        values = record_buffers(prototype, size)
        kept = {path: values[path] for path in values if path not in dropped}
        changed = record_buffers(made_prototype, size) | kept
        written = {path: changed[path] for path, _ in leaves(made_prototype)}
        with (
            record_writer(self._file, made, written) as write,
            closing(read_records(node, values, self._report)) as chunks,
        ):
            for some in chunks:
                if fill is not None:
                    fill(some, changed)
                write(some)
                self._report(some)

    def _bytes(self, node: Any, made: Any) -> None:
        left = node.byteCount()
        buffer = np.zeros(max(1, min(left, _BLOB_BYTES_AT_ONCE)), np.uint8)
        for first in range(0, left, len(buffer)):
            some = min(len(buffer), left - first)
            node.read(buffer, first, some)
            made.write(buffer, first, some)
            self._report(0)


def leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the fields of a prototype by their paths."""
    for index in range(node.childCount()):
        child = node[index]
        name = f"{path}{child.elementName()}"
        if isinstance(child, library().StructureNode):
            yield from leaves(child, f"{name}/")
        else:
            yield name, child


def record_buffers(prototype: Any, size: int) -> Buffers:
    """Return arrays for the raw values of records.

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
            raise ExportError(
                f"the field {one_line(path, 40)} of the E57's points is not a number, and only numbers can be copied; "
                "export the scan without it"
            )
    return buffers


def read_records(node: Any, buffers: Buffers, report: Callable[[int], None]) -> Generator[int, None, None]:
    """Read records of a compressed vector into buffers again and again; yields how many were read.

    Args:
        node: the compressed vector.
        buffers: those of the fields that are wanted.
        report: called before every chunk; may raise `Cancelled`.

    Raises:
        FormatError: if there are fewer than the vector claims.
    """
    count, done = node.childCount(), 0
    if not count:
        return
    reader = node.reader(_bound(node.destImageFile(), buffers))
    try:
        while done < count:
            report(0)
            some = min(reader.read(), count - done)
            if some == 0:
                raise FormatError(f"the points of the E57 end after {done:,} of {count:,}; it is truncated")
            yield some
            done += some
    finally:
        reader.close()


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
