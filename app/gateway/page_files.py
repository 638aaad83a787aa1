"""The page as a browser loads it: scripts and styles under a path with a hash of their content, compressed.

There is no build step. Scripts are plain modules that import each other by relative paths, so that one hash in the path
of the first one versions all of them, and browsers may keep them indefinitely. A file that is edited while the program
runs changes the hash, and thus arrives with the next reload.
"""

from __future__ import annotations

import gzip
import hashlib
import html
import mimetypes
import posixpath
import re
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

_FOLDER = "v"
"""First part of the versioned paths: `v/HASH/js/main.js`."""
_SUFFIXES = (".js", ".css", ".svg")
_FOR_EVER = {"cache-control": "private, max-age=31536000, immutable"}
_REVALIDATE = {"cache-control": "no-cache"}
_HASH_DIGITS = 16
_LINKED = re.compile(r'\b(href|src)="([\w/.-]+\.(?:js|css|svg))"')
_IMPORTED = re.compile(r"""^(?:import|export)\s(?:[^;]*?\sfrom\s)?["'](\.[^"']+)["']""", re.M)
_ENTRY = re.compile(r'<script type="module" src="([\w/.-]+)">')
_PRELOADS, _PICTURE = "<!-- preloads: {what} -->", "<!-- picture of the {side} -->"

_VIEWER = "<!-- viewer -->"
_FIRST = '<img class="first-picture" alt="" draggable="false" fetchpriority="high" src="{}">'


@dataclass(frozen=True, slots=True)
class _File:
    """A script or a style."""

    plain: bytes
    packed: bytes
    media_type: str


@dataclass(frozen=True, slots=True)
class _Edition:
    """All scripts and styles as they are at one time."""

    stamps: tuple[tuple[str, int, int], ...]
    """Path, time of modification and size of each file."""
    name: str
    """Hash of their content."""
    files: Mapping[str, _File]
    """By path."""


class PageFiles:
    """Serves the page, and its scripts and styles by version.

    Args:
        folder: of the page's files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._edition = _Edition((), "", {})

    def front_page(self, pictures: Mapping[str, str], headers: Headers, *, viewer: str | None = None) -> Response:
        """Return `index.html`, with links to the present version of its scripts and styles.

        Args:
            pictures: URL, relative to the page, of the first picture of each pane: `scan`, `photo`. The browser
                requests them before everything else, and shows them until the scripts do.
            headers: of the request.
            viewer: URL of viser's page, which scripts request after the pictures; None: it is not known yet.
        """
        try:
            text = (self._folder / "index.html").read_text(encoding="utf-8")
        except OSError:
            raise HTTPException(404) from None
        edition = self._present_edition()
        entries = _ENTRY.findall(text)
        # In this order and with this priority, browsers request the pictures, and then what the first paint needs.
        urgent = '<link rel="preload" as="image" fetchpriority="high" href="{}">'
        preloads = {
            "pictures": [urgent.format(html.escape(url)) for url in pictures.values()],
            "modules": [f'<link rel="modulepreload" href="{path}">' for path in _imported_by(entries, edition.files)],
        }
        for what, links in preloads.items():
            text = text.replace(_PRELOADS.format(what=what), "\n    ".join(links))
        text = text.replace(_VIEWER, f'<meta name="viewer" content="{html.escape(viewer)}">' if viewer else "")
        for side in ("scan", "photo"):
            url = pictures.get(side)
            image = _FIRST.format(html.escape(url)) if url else ""
            text = text.replace(_PICTURE.format(side=side), image)

        def versioned(found: re.Match[str]) -> str:
            path = found[2]
            return f'{found[1]}="{_FOLDER}/{edition.name}/{path}"' if path in edition.files else found[0]

        return _answer(_packed_file(_LINKED.sub(versioned, text).encode(), "text/html"), headers, _REVALIDATE)

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
        if b"\nexport " in found.plain:
            up = "../" * (len(PurePosixPath(path).parts) - 1)
            text = f'export * from "{up}{_FOLDER}/{edition.name}/{path}";\n'
            found = _packed_file(text.encode(), found.media_type)
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
            if path.suffix in _SUFFIXES and not any(part.startswith(".") for part in inner.parts):
                stat = path.stat()
                found.append((inner.as_posix(), stat.st_mtime_ns, stat.st_size))
        return tuple(sorted(found))

    def _read(self, stamps: tuple[tuple[str, int, int], ...]) -> _Edition:
        digest = hashlib.sha256()
        files = {}
        for path, _, _ in stamps:
            plain = (self._folder / path).read_bytes()
            digest.update(f"{path}\0{len(plain)}\0".encode() + plain)
            files[path] = _packed_file(plain, mimetypes.guess_type(path)[0] or "text/plain")
        return _Edition(stamps, digest.hexdigest()[:_HASH_DIGITS], files)


def _packed_file(plain: bytes, media_type: str) -> _File:
    return _File(plain, gzip.compress(plain, 9, mtime=0), media_type)


def _imported_by(entries: list[str], files: Mapping[str, _File]) -> list[str]:
    """Return modules and everything that they import: what the first needs, then what else the next needs."""
    found: list[str] = []
    for entry in entries:
        waiting = [entry]
        for path in waiting:
            if path in files and path not in found:
                found.append(path)
                names = _IMPORTED.findall(files[path].plain.decode())
                waiting += [posixpath.normpath(posixpath.join(posixpath.dirname(path), name)) for name in names]
    return found


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
