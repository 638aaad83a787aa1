"""Images for the page: rendered, encoded and cached."""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project import edits

from ...gateway.protocol import Picture
from ...session.loader import Loader
from ...session.session import Session
from .slices import photo_revision, scan_id

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ladarreg_core.frames import Rigid
    from ladarreg_core.inspection.picture_forms import EncodedPicture
    from ladarreg_core.project.document import Document, PhotoEntry, PoseEntry
    from ladarreg_core.scan import Scan

log = logging.getLogger(__name__)
_OF_NO_PIXEL = frozenset(("rev", "stage", "form", "part"))
"""Parameters on which the pixels of an overlay do not depend."""
_MAX_DIGITS = 9


class Images:
    """Renders the images of the page."""

    def __init__(self, session: Session, loader: Loader) -> None:
        self._session = session
        self._loader = loader

    def picture(self, path: str, query: Mapping[str, str]) -> Picture:
        """Return an image.

        Args:
            path: path below `picture/`: `scan`, `strip`, `photo/ID`, `overlay/ID` or `registered/ID`.
            query: query parameters, see docs/workbench.md; `rev` of a scan says which one of the project's is meant.

        Raises:
            LadarregError: if there is no such image.
        """
        kind, _, photo_id = path.strip("/").partition("/")
        document = self._session.document
        if kind == "scan" and not photo_id:
            return self._scan(self._of_scan(query.get("rev", "")), query)
        if kind == "strip" and not photo_id:
            return self._strip(self._of_scan(query.get("rev", "")), query)
        entry = document.photo(photo_id)
        if entry is None:
            raise OptionError("there is no such photograph")
        if kind == "photo" and query.get("form") == "small" and "part" not in query:
            return _with_etag(self._loader.small_photo(entry))  # without reading the photograph
        if kind == "photo":
            key: Any = ("photo", entry.source, entry.camera.file)
            return self._sent(key, lambda: self._loader.viewable_photo(entry).pixels, query, natural=True)
        options = tuple(sorted((k, v) for k, v in query.items() if k not in _OF_NO_PIXEL))
        if kind == "overlay" and "pose" in query:
            placed = _placed(query["pose"])
            key = ("placed", document.beside(entry).scan, entry.source, entry.camera, options)
            return self._sent(key, lambda: self._preview(entry, placed, query), query)
        pose = entry.stage(query["stage"]) if query.get("stage") else entry.pose
        if pose is None or kind not in ("overlay", "registered"):
            raise OptionError("there is no pose to overlay; solve first")
        make = self._overlay if kind == "overlay" else self._registered
        return self._sent((kind, id(pose), options), lambda: make(entry, pose, query), query, keep=pose)

    def first_pictures(self, shown: PhotoEntry | None) -> dict[str, str]:
        """Return the URLs that a new page requests first (static/js/panes/sides.js), for a photograph that it shows.

        Args:
            shown: the photograph; None: there is none.
        """
        found = {}
        scan = self._loader.known("picture", ("scan slice", self._session.document.beside(shown).scan))
        if scan and scan["views"]:
            show = "intensity" if scan["has_intensity"] else "shape"
            found["scan"] = (
                f"picture/scan?view=0&show={show}&low=1&high=99.5&equalise=0&gamma=0.6&rev={scan['id']}&form=quick"
            )
        if shown is not None:
            found["photo"] = f"picture/photo/{quote(shown.id)}?rev={photo_revision(shown)}&form=quick"
        return found

    def prerender(self) -> None:
        """Render the scan in its default display, in a thread; it is the first image that a page requests."""

        def render() -> None:
            try:
                for form in ("quick", "exact"):
                    self._scan(self._session.document, {"form": form})
            except LadarregError as error:
                log.debug("there is nothing to render: %s", error)
            except Exception:  # a page that requests the image gets the error
                log.exception("the scan could not be rendered")

        threading.Thread(target=render, name="picture", daemon=True).start()

    def _sent(
        self,
        key: tuple[Any, ...],
        make: Callable[[], NDArray[np.uint8]],
        query: Mapping[str, str],
        *,
        keep: object = None,
        natural: bool = False,
    ) -> Picture:
        """Return an image in the form that the query asks for.

        Args:
            key: identifies its pixels.
            make: renders them.
            query: with `form` or `part`.
            keep: the object whose id is part of the key.
            natural: whether it is a photograph.
        """
        from ladarreg_core.inspection import picture_forms

        form = query.get("form", "exact")
        if form not in picture_forms.FORMS:
            raise OptionError(f"a picture has no form {form[:20]!r}; choose one of {', '.join(picture_forms.FORMS)}")

        def cached(what: object, value: Callable[[], Any]) -> Any:
            return self._loader.cached("picture", (what, *key), lambda: (keep, value()))[1]

        def pixels() -> NDArray[np.uint8]:
            found: NDArray[np.uint8] = make() if natural else cached("pixels", make)
            return found

        if "part" in query:
            level, column, row = picture_forms.level_column_row(query["part"])
            of_level = cached(("level", level), lambda: picture_forms.reduced(pixels(), level)) if level else pixels()
            return _with_etag(picture_forms.part(of_level, column, row))
        encoded = {
            "exact": lambda: picture_forms.exact(pixels(), natural=natural),
            "quick": lambda: picture_forms.quick(pixels()),
            "small": lambda: picture_forms.small(pixels()),
        }
        found: Picture = cached(form, lambda: _with_etag(encoded[form]()))
        return found

    def _of_scan(self, rev: str) -> Document:
        """Return the document with the scan of an id as its scan; as it is where none of its stations has that id."""
        document = self._session.document
        found = next((station for station in document.stations if scan_id(station.source) == rev), None)
        return document if found is None else replace(document, scan=found.source)

    def _scan(self, document: Document, query: Mapping[str, str]) -> Picture:
        from ladarreg_core.inspection.pictures import Stretch, scan_picture, usual_show

        index = self._view_number(document, query)
        show = query.get("show") or usual_show(self._scan_or_raise(document))
        stretch = Stretch(
            low=_number(query, "low", 1.0),
            high=_number(query, "high", 99.5),
            gamma=_number(query, "gamma", 0.6),
            equalise=query.get("equalise") == "1",
        )
        key = ("scan", document.scan, index, show, stretch)
        return self._sent(key, lambda: scan_picture(self._loader.view(document, index), show, stretch), query)

    def _strip(self, document: Document, query: Mapping[str, str]) -> Picture:
        from ladarreg_core.inspection.panorama import strip_picture

        scan = self._scan_or_raise(document)
        return self._sent(("strip", document.scan), lambda: strip_picture(scan), query)

    def _overlay(self, entry: PhotoEntry, pose: PoseEntry, query: Mapping[str, str]) -> NDArray[np.uint8]:
        from ladarreg_core.inspection.pictures import scan_over_photo

        result = self._loader.registration(pose)
        show = query.get("show", "intensity")
        scan = self._scan_or_raise(self._session.document.beside(entry))
        return scan_over_photo(scan, result.camera, result.camera_from_scanner, show)

    def _preview(self, entry: PhotoEntry, placed: Rigid, query: Mapping[str, str]) -> NDArray[np.uint8]:
        """Render what the photograph's camera would see of the scan at a pose."""
        from ladarreg_core.inspection.pictures import scan_over_photo

        camera = self._loader.photo(entry).camera
        scan = self._scan_or_raise(self._session.document.beside(entry))
        return scan_over_photo(scan, camera, placed, query.get("show", "intensity"))

    def _registered(self, entry: PhotoEntry, pose: PoseEntry, query: Mapping[str, str]) -> NDArray[np.uint8]:
        from ladarreg_core.inspection.model_textures import texture_without_z_buffer
        from ladarreg_core.inspection.pictures import photo_over_scan
        from ladarreg_core.surface.texture.registered_texture import texture_scan

        document = self._session.document.beside(entry)
        scan, result, photo = self._scan_or_raise(document), self._loader.registration(pose), self._loader.photo(entry)
        if query.get("z_buffer") == "0":
            texture = texture_without_z_buffer(scan, photo, result)
        else:
            texture = texture_scan(scan, photo, result.camera_from_scanner, camera=result.camera)
        return photo_over_scan(self._loader.view(document, self._view_number(document, query)), texture)

    def _scan_or_raise(self, document: Document) -> Scan:
        scan = self._loader.scan(document)
        if scan is None:
            raise OptionError("there is no scan; open one")
        return scan

    def _view_number(self, document: Document, query: Mapping[str, str]) -> int:
        views = self._loader.views(document)
        if not views:
            raise OptionError("there is no scan; open one")
        index = query.get("view", "0")
        if not index.isdecimal() or len(index) > _MAX_DIGITS or int(index) >= len(views):
            raise OptionError(f"there is no view {index[:20]!r}; the scan has {len(views)}")
        return int(index)


def _placed(text: str) -> Rigid:
    """Return a pose from the 12 numbers of its upper three rows, separated by commas."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 12:
        raise OptionError("a pose has 12 numbers, the upper three rows of camera_from_scanner")
    return edits.pose([*(numbers[k : k + 4] for k in (0, 4, 8)), [0, 0, 0, 1]])


def _number(query: Mapping[str, str], name: str, otherwise: float) -> float:
    try:
        return float(query.get(name, otherwise))
    except ValueError:
        raise OptionError(f"{name} is {query[name]!r}; it must be a number") from None


def _with_etag(picture: EncodedPicture) -> Picture:
    return Picture(picture.data, picture.media_type, hashlib.sha256(picture.data).hexdigest()[:16])
