"""The tree of an E57 file: its 48-byte header and the XML at the end, validated while it is parsed.

The XML comes from strangers. It declares no document type, no entities and no processing instructions, and does not
refer to a schema: what could make a program open another file, or a connection, is refused. Nothing else than the bytes
of this file is ever read.

Source: ASTM E2807-11, 8.2 (header), 8.4 (XML).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.e57.pages import PAGE_BYTES, E57Pages
from ladarreg_core.formats.parsing.untrusted import one_line

SIGNATURE = b"ASTM-E57"
_HEADER = struct.Struct("<8sIIQQQQ")
_BLOB_HEADER = struct.Struct("<B7xQ")
_BLOB_SECTION = 0
_LARGEST_XML = 32 << 20
_DEEPEST = 64
_MAX_ELEMENTS = 500_000
_MAX_CHILDREN = 4_000  # libe57, which writes the copies, compares the names of all of them
_SCHEMA_INSTANCE = "http://www.w3.org/2001/XMLSchema-instance"
_MALICIOUS = "it is malicious or damaged: export it again"


@dataclass(slots=True)
class E57Node:
    """An element of the tree."""

    name: str
    """Its name, with the prefix of an extension."""
    attributes: dict[str, str]
    """Its attributes by name."""
    children: list[E57Node] = field(default_factory=list)
    """Its elements, in the file's order."""
    text: str = ""
    """Its text, as it is; empty in elements with children."""

    @property
    def kind(self) -> str:
        """Its type: `Structure`, `Vector`, `CompressedVector`, `Integer`, `ScaledInteger`, `Float`, `String`, `Blob`.

        Empty where the file gives none.
        """
        return self.attributes.get("type", "")

    def child(self, *path: str) -> E57Node | None:
        """Return the element at the end of a path of names; None if there is none."""
        node: E57Node | None = self
        for name in path:
            node = None if node is None else next((child for child in node.children if child.name == name), None)
        return node

    def number(self) -> float:
        """Return the value of a number, scaled; an empty element means 0.

        Raises:
            FormatError: if it is not a number.
        """
        try:
            value = float(self.text.strip() or 0)
            if self.kind == "ScaledInteger":
                value = value * self.real("scale", 1.0) + self.real("offset", 0.0)
        except ValueError:
            text = one_line(self.text.strip(), 30)
            raise FormatError(f"the E57's {self.name} is {text!r}; it must be a number") from None
        return value

    def real(self, attribute: str, default: float) -> float:
        """Return an attribute that is a number.

        Raises:
            FormatError: if it is not.
        """
        text = self.attributes.get(attribute, "")
        try:
            return float(text) if text else default
        except ValueError:
            raise FormatError(f"the E57's {attribute} is {one_line(text, 30)!r}; it must be a number") from None

    def whole(self, attribute: str, default: int = 0) -> int:
        """Return an attribute that is a whole number.

        Raises:
            FormatError: if it is not.
        """
        return whole_number(self.attributes.get(attribute, ""), attribute, default)


def whole_number(text: str, what: str, default: int = 0) -> int:
    """Return a whole number of 64 bits from its text; a default where the text is empty.

    Raises:
        FormatError: if it is something else.
    """
    if not text:
        return default
    digits = text.removeprefix("-").removeprefix("+")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 19) or not -(2**63) <= int(text) < 2**63:
        raise FormatError(f"the E57's {what} is {one_line(text, 30)!r}; it must be a whole number of 64 bits")
    return int(text)


@dataclass(frozen=True, slots=True)
class E57File:
    """An open E57 file."""

    pages: E57Pages
    """Its bytes."""
    root: E57Node
    """Its tree."""

    @property
    def extensions(self) -> dict[str, str]:
        """Addresses of the namespaces by their prefix; that of E57 itself is empty."""
        found = {}
        for name, value in self.root.attributes.items():
            kind, _, prefix = name.partition(":")
            if kind == "xmlns":
                found[prefix] = value
        return found

    def scan(self, index: int) -> E57Node:
        """Return a scan that is known to exist."""
        data3d = self.root.child("data3D")
        assert data3d is not None, "the table of contents names it"
        return data3d.children[index]

    def blob(self, offset: int, length: int) -> NDArray[np.uint8]:
        """Return the bytes (length,) of a blob.

        Args:
            offset: its physical offset.
            length: its size, bytes.

        Raises:
            FormatError: if there is none, or it is damaged.
        """
        start = self.pages.logical(offset, "a picture")
        (kind, _) = _BLOB_HEADER.unpack(self.pages.read(start, _BLOB_HEADER.size, "a picture").tobytes())
        if kind != _BLOB_SECTION:
            raise FormatError(
                f"the E57 has no picture at byte {offset:,}, where its XML puts one; it is damaged: export it again"
            )
        return self.pages.read(start + _BLOB_HEADER.size, length, "a picture")


@contextmanager
def open_e57(path: Path) -> Iterator[E57File]:
    """Open an E57 file and parse its tree.

    Args:
        path: an existing file.

    Raises:
        FormatError: if it is truncated, damaged, or its XML contains what E57 does not allow.
    """
    size = path.stat().st_size
    with open(path, "rb") as stream:
        head = stream.read(_HEADER.size)
        pages = E57Pages(stream, size)
        yield E57File(pages, _parsed(_xml(head, pages)))


def _xml(head: bytes, pages: E57Pages) -> bytes:
    size = pages.file_bytes
    if len(head) < _HEADER.size or not head.startswith(SIGNATURE):
        raise FormatError("it is not an E57 file; an E57 begins with 'ASTM-E57' and a header of 48 bytes")
    _, major, _, length, xml_at, xml_length, page = _HEADER.unpack(head)
    if major != 1 or page != PAGE_BYTES:
        raise FormatError(f"it is E57 version {major} with pages of {page} bytes; version 1 with {PAGE_BYTES} is read")
    if length != size:
        state = "truncated" if length > size else "damaged"
        raise FormatError(f"its header says {length:,} bytes, the file has {size:,}; it is {state}: copy it again")
    if xml_length > min(_LARGEST_XML, size) or xml_at < _HEADER.size or xml_at >= size:
        raise FormatError(f"its header puts {xml_length:,} bytes of XML at {xml_at:,} of {size:,}; it is damaged")
    xml = pages.read(pages.logical(xml_at, "its XML"), xml_length, "the XML")
    return xml.tobytes().rstrip(b"\0")


class _Parser:
    """Builds the tree of an XML text; whatever exhausts or misleads XML parsers ends it with a `FormatError`."""

    def __init__(self) -> None:
        self._open: list[E57Node] = []
        self._texts: list[str] = []
        self._count = 0
        self._schema_prefixes = {"xsi"}
        self.root: E57Node | None = None

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._count += 1 + len(attributes)
        if len(self._open) + 1 > _DEEPEST or self._count > _MAX_ELEMENTS:
            raise FormatError(
                f"the E57's XML is nested {len(self._open) + 1} deep with {self._count:,} elements; it is malicious or "
                "damaged"
            )
        for key, value in attributes.items():
            if key.startswith("xmlns:") and value.strip() == _SCHEMA_INSTANCE:
                self._schema_prefixes.add(key[6:])
        for key in attributes:
            if key.partition(":")[0] in self._schema_prefixes and ":" in key:
                raise FormatError(
                    f"the E57's XML refers to a schema ({one_line(key, 40)}), which could open files; {_MALICIOUS}"
                )
        node = E57Node(name, attributes)
        if self._open:
            siblings = self._open[-1].children
            if len(siblings) >= _MAX_CHILDREN:
                raise FormatError(
                    f"an element of the E57's XML contains more than {_MAX_CHILDREN:,} others; it is malicious or "
                    "damaged"
                )
            siblings.append(node)
        else:
            self.root = node
        self._open.append(node)
        self._texts.clear()

    def text(self, text: str) -> None:
        self._texts.append(text)

    def end(self, _: str) -> None:
        node = self._open.pop()
        if not node.children:
            node.text = "".join(self._texts)
        self._texts.clear()

    def doctype(self, *_: object) -> None:
        raise FormatError(f"the E57's XML declares a document type, which E57 does not allow; {_MALICIOUS}")

    def instruction(self, target: str, _: str) -> None:
        raise FormatError(
            f"the E57's XML contains a processing instruction ({one_line(target, 40)}), which E57 does not allow; "
            f"{_MALICIOUS}"
        )


def _parsed(xml: bytes) -> E57Node:
    made = _Parser()
    parser = expat.ParserCreate("UTF-8")  # the only encoding of E57, whatever the XML declares
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = made.start, made.end
    parser.CharacterDataHandler = made.text
    parser.StartDoctypeDeclHandler = made.doctype
    parser.ProcessingInstructionHandler = made.instruction
    try:
        parser.Parse(xml, True)
    except expat.ExpatError as error:
        if error.code == expat.errors.codes[expat.errors.XML_ERROR_UNDEFINED_ENTITY]:
            raise FormatError(f"the E57's XML uses an entity, which E57 does not allow; {_MALICIOUS}") from error
        raise FormatError(f"the E57's XML is damaged ({one_line(error, 80)}); copy or export it again") from error
    assert made.root is not None, "expat refuses a text without an element"
    return made.root
