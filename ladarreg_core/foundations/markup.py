"""HTML and SVG in which every text is escaped: only `tag` makes markup, and it escapes whatever is not markup."""

from __future__ import annotations

import base64
import html
import unicodedata
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import cv2

from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.encoded_image import encoded_image

_VOID = frozenset({"br", "hr", "img", "meta", "link"})
_JPEG_QUALITY = 88


class Html(str):
    """Markup, as opposed to text that has to be escaped."""

    __slots__ = ()


class DataUri(str):
    """An embedded image: a long text that has no character to be escaped."""

    __slots__ = ()


Content: TypeAlias = "Html | str | Iterable[Html | str]"


def tag(name: str, /, *content: Content, **attributes: str | float | None) -> Html:
    """Return an element.

    Args:
        name: its name.
        content: markup, texts (which are escaped), or sequences of both.
        attributes: its attributes; `_` stands for `-`, a trailing one is dropped (`class_`), and None leaves one out.
    """
    opening = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{_escaped(_number(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Html(f"<{name}{opening}>")
    return Html(f"<{name}{opening}>{joined(*content)}</{name}>")


def joined(*content: Content) -> Html:
    """Return markup and texts, or sequences of both, as markup."""
    parts = []
    for one in content:
        if isinstance(one, Html):
            parts.append(str(one))
        elif isinstance(one, str):
            parts.append(_escaped(one))
        else:
            parts.append(str(joined(*one)))
    return Html("".join(parts))


def section(name: str, title: str, *content: Content) -> Html:
    """Return a section with its heading; `name` is its id."""
    return tag("section", tag("h2", title), *content, id=name)


def figure(uri: str, caption: str, *, wide: bool = False) -> Html:
    """Return an image, by its data URI, with its caption; a wide one fills the page."""
    return tag("figure", tag("img", src=uri, alt=caption), tag("figcaption", caption), class_="wide" if wide else None)


def definitions(rows: Sequence[tuple[str, str]]) -> Html:
    """Return terms with their values."""
    return tag("dl", [joined(tag("dt", name), tag("dd", value)) for name, value in rows])


def table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Sequence[int] = (), code: Sequence[int] = ()
) -> Html:
    """Return a table.

    Args:
        heads: the heads of its columns; empty: none.
        rows: its rows.
        numbers: columns of numbers.
        code: columns in a fixed-width font.
    """

    def kind(k: int) -> str | None:
        return "number" if k in numbers else "code" if k in code else None

    head = [tag("thead", tag("tr", [tag("th", name, class_=kind(k)) for k, name in enumerate(heads)]))] if heads else []
    body = [tag("tr", [tag("td", cell, class_=kind(k)) for k, cell in enumerate(row)]) for row in rows]
    return tag("table", head, tag("tbody", body))


def photograph_uri(picture: ByteArray) -> DataUri:
    """Return an image (H, W, 3) as the data URI of a JPEG."""
    return _data_uri("image/jpeg", encoded_image(picture, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]))


def map_uri(picture: ByteArray) -> DataUri:
    """Return an image (H, W, 3), whose exact colours matter, as the data URI of a PNG."""
    return _data_uri("image/png", encoded_image(picture, ".png"))


def _data_uri(media_type: str, content: bytes) -> DataUri:
    return DataUri(f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}")


def _number(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _escaped(text: str) -> str:
    """Return a text for content and quoted attributes; control and direction marks become visible."""
    if isinstance(text, DataUri):
        return text
    if text.isascii() and text.isprintable():
        return html.escape(text, quote=True)
    shown = "".join(c if c in "\n\t" or unicodedata.category(c)[0] != "C" else "\ufffd" for c in text)
    return html.escape(shown, quote=True)
