"""Small XML files from anywhere: document types, entities and deep nesting are refused before anything is built."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.parsers import expat

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.untrusted import one_line

_DEEPEST = 30
_MAX_ELEMENTS = 400_000


def read_xml(path: Path, longest_bytes: int, what: str) -> ElementTree.Element:
    """Return the root of an XML file.

    Raises:
        FormatError: if it is too large, damaged, nested too deeply, or declares a document type.
    """
    size = path.stat().st_size
    if size > longest_bytes:
        raise FormatError(f"it has {size:,} bytes; {what} has at most {longest_bytes:,}: give the right file")
    return parsed_xml(path.read_bytes(), what)


def parsed_xml(data: bytes, what: str) -> ElementTree.Element:
    """Return the root of XML from anywhere.

    Raises:
        FormatError: if it is damaged, nested too deeply, or declares a document type.
    """
    _check(data, what)
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:  # a prefix without a namespace
        raise FormatError(f"its XML is damaged ({one_line(error, 80)}); export it again") from error


def _check(data: bytes, what: str) -> None:
    parser = expat.ParserCreate()
    depth = count = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth += 1
        count += 1 + len(attributes)
        if depth > _DEEPEST or count > _MAX_ELEMENTS:
            raise FormatError(f"its XML is nested too deeply or has too many elements for {what}; give the right file")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    def doctype(*_: object) -> None:
        raise FormatError(f"its XML declares a document type, which {what} does not; it is malicious or damaged")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # LookupError: an unknown encoding
        raise FormatError(f"its XML is damaged ({one_line(error, 80)}); export it again") from error
