"""The page as a browser loads it: scripts and styles under a path with a hash of their content, compressed.

There is no build step. Scripts are plain modules and styles plain files, which are served in few requests: the scripts
in a bundle for each entry, the styles in one. One hash in the path versions all of them, so that browsers may keep them
indefinitely. A file that is edited while the program runs changes the hash, and thus arrives with the next reload.
"""

from __future__ import annotations

import gzip
import hashlib
import html
import mimetypes
import re
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from .bundles import Bundle, bundled, re_exported

_FOLDER = "v"
"""First part of the versioned paths: `v/HASH/js/main.js`."""
_SUFFIXES = (".js", ".css", ".svg")
_PAGE = Path("index.html")
_FOR_EVER = {"cache-control": "private, max-age=31536000, immutable"}
_REVALIDATE = {"cache-control": "no-cache"}
_HASH_DIGITS = 16
_LINKED = re.compile(r'\b(href|src)="([\w/.-]+\.(?:js|css|svg))"')
_ENTRY = re.compile(r'(<script type="module" src=")([\w/.-]+)(">)')
_STYLES = re.compile(r'(?:<link rel="stylesheet" href="[\w/.-]+">\s*)+')
_STYLE = re.compile(r'<link rel="stylesheet" href="([\w/.-]+)">')
_BUNDLES, _SHEET, _MAP = "bundle", "bundle/page.css", ".map"
_PRELOADS, _PICTURE = "<!-- preloads: pictures -->", "<!-- picture of the {side} -->"

_VIEWER = "<!-- viewer -->"
_FIRST = '<img class="first-picture" alt="" draggable="false" fetchpriority="high" src="{}">'


class _File:
    """A script or a style."""

    def __init__(self, plain: bytes, path: str) -> None:
        self.plain = plain
        self.media_type = mimetypes.guess_type(path)[0] or "text/plain"

    @cached_property
    def packed(self) -> bytes:
        """The file compressed; of what nobody asks for it is never made."""
        return gzip.compress(self.plain, 9, mtime=0)


@dataclass(frozen=True, slots=True)
class _Edition:
    """All scripts and styles as they are at one time."""

    stamps: tuple[tuple[str, int, int], ...]
    """Path, time of modification and size of each file."""
    name: str
    """Hash of their content."""
    page: str
    """`index.html`, whose links are those of the bundles."""
    files: Mapping[str, _File]
    """By path, the bundles among them."""
    bundles: Mapping[str, Bundle]
    """The bundles by the paths of their entries."""


class PageFiles:
    """Serves the page, and its scripts and styles by version.

    Args:
        folder: of the page's files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._edition = _Edition((), "", "", {}, {})

    def front_page(self, pictures: Mapping[str, str], headers: Headers, *, viewer: str | None = None) -> Response:
        """Return `index.html`, with links to the present version of its scripts and styles.

        Args:
            pictures: URL, relative to the page, of the first picture of each pane: `scan`, `photo`. The browser
                requests them before everything else, and shows them until the scripts do.
            headers: of the request.
            viewer: URL of viser's page, which scripts request after the pictures; None: it is not known yet.
        """
        edition = self._present_edition()
        if not edition.page:
            raise HTTPException(404)
        # In this order and with this priority, browsers request the pictures, and then what the first paint needs.
        urgent = '<link rel="preload" as="image" fetchpriority="high" href="{}">'
        links = [urgent.format(html.escape(url)) for url in pictures.values()]
        text = edition.page.replace(_PRELOADS, "\n    ".join(links))
        text = text.replace(_VIEWER, f'<meta name="viewer" content="{html.escape(viewer)}">' if viewer else "")
        for side in ("scan", "photo"):
            url = pictures.get(side)
            image = _FIRST.format(html.escape(url)) if url else ""
            text = text.replace(_PICTURE.format(side=side), image)

        def versioned(found: re.Match[str]) -> str:
            path = found[2]
            return f'{found[1]}="{_FOLDER}/{edition.name}/{path}"' if path in edition.files else found[0]

        return _answer(_File(_LINKED.sub(versioned, text).encode(), "index.html"), headers, _REVALIDATE)

    def versioned(self, request: Request) -> Response:
        """Return a script or a style of the version in the path; of another version, the present one for this time."""
        name, path = request.path_params["version"], request.path_params["path"]
        edition = self._edition if name == self._edition.name else self._present_edition()
        found = edition.files.get(path)
        if found is None:
            raise HTTPException(404)
        return _answer(found, request.headers, _FOR_EVER if name == edition.name else _REVALIDATE)

    def unversioned(self, request: Request) -> Response:
        """Return what a script exports, by its plain name: the same modules as the page's, not second ones."""
        path = f"js/{request.path_params['path']}"
        edition = self._present_edition()
        found = edition.files.get(path)
        if found is None:
            raise HTTPException(404)
        up = "../" * (len(PurePosixPath(path).parts) - 1) + f"{_FOLDER}/{edition.name}/{_BUNDLES}/"
        for entry, bundle in edition.bundles.items():
            if names := bundle.exports.get(path):
                found = _File(re_exported(names, path, up + entry).encode(), path)
        return _answer(found, request.headers, _REVALIDATE)

    def _present_edition(self) -> _Edition:
        with self._lock:
            stamps = self._stamps()
            if stamps != self._edition.stamps:
                self._edition = self._read(stamps)
            return self._edition

    def _stamps(self) -> tuple[tuple[str, int, int], ...]:
        found = []
        for path in self._folder.rglob("*"):
            inner = path.relative_to(self._folder)
            if (path.suffix in _SUFFIXES or inner == _PAGE) and not any(part.startswith(".") for part in inner.parts):
                stat = path.stat()
                found.append((inner.as_posix(), stat.st_mtime_ns, stat.st_size))
        return tuple(sorted(found))

    def _read(self, stamps: tuple[tuple[str, int, int], ...]) -> _Edition:
        digest = hashlib.sha256()
        plain = {path: (self._folder / path).read_bytes() for path, _, _ in stamps}
        for path, data in plain.items():
            digest.update(f"{path}\0{len(data)}\0".encode() + data)
        page = plain.pop("index.html", b"").decode()
        scripts = {path: data.decode() for path, data in plain.items() if path.endswith(".js")}
        bundles = bundled([path for _, path, _ in _ENTRY.findall(page)], scripts, folder=_BUNDLES)
        made = {_SHEET: b"".join(plain.get(path, b"") for path in _STYLE.findall(page))}
        for entry, bundle in bundles.items():
            path = f"{_BUNDLES}/{entry}"
            made |= {path: bundle.text.encode(), path + _MAP: bundle.source_map.encode()}
        page = _ENTRY.sub(rf"\1{_BUNDLES}/\2\3", page)
        page = _STYLES.sub(f'<link rel="stylesheet" href="{_SHEET}">\n    ', page, count=1)
        files = {path: _File(data, path) for path, data in {**plain, **made}.items()}
        return _Edition(stamps, digest.hexdigest()[:_HASH_DIGITS], page, files, bundles)


def _answer(file: _File, headers: Headers, caching: Mapping[str, str]) -> Response:
    """Return a file in the encoding that the browser accepts, or 304 if its copy is current."""
    packs = "gzip" in headers.get("accept-encoding", "")
    data = file.packed if packs else file.plain
    etag = f'"{hashlib.sha256(data).hexdigest()[:_HASH_DIGITS]}"'
    sent = {**caching, "etag": etag, "vary": "accept-encoding"}
    if etag in (tag.strip().removeprefix("W/") for tag in headers.get("if-none-match", "").split(",")):
        return Response(status_code=304, headers=sent)
    if packs:
        sent["content-encoding"] = "gzip"
    return Response(data, headers=sent, media_type=file.media_type)
