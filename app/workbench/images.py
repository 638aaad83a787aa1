"""Images for the page: rendered, encoded and cached."""

from __future__ import annotations

import hashlib
import io
import logging
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError, OptionError

from ..gateway.protocol import Picture
from ..session.loader import Loader
from ..session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.project.document import PhotoEntry, PoseEntry
    from ladarreg_core.scan import Scan
    from ladarreg_core.surface.perspective import View

log = logging.getLogger(__name__)
_JPEG_ABOVE_PIXELS = 2_500_000
_JPEG_QUALITY = 93
_MAX_DIGITS = 9


class Images:
    """Renders the images of the page."""

    def __init__(self, session: Session, loader: Loader) -> None:
        self._session = session
        self._loader = loader

    def picture(self, path: str, query: Mapping[str, str]) -> Picture:
        """Return an image.

        Args:
            path: path below `picture/`: `scan`, `photo/ID`, `overlay/ID` or `registered/ID`.
            query: query parameters, see docs/workbench.md.

        Raises:
            LadarregError: if there is no such image.
        """
        kind, _, photo_id = path.strip("/").partition("/")
        document = self._session.document
        if kind == "scan" and not photo_id:
            return self._scan(query)
        entry = document.photo(photo_id)
        if entry is None:
            raise OptionError("there is no such photograph")
        if kind == "photo":
            key: Any = (entry.source, entry.camera.file)
            return self._loader.cached("picture", ("photo", key), lambda: self._photo(entry))
        pose = entry.stage(query["stage"]) if query.get("stage") else entry.pose
        if pose is None or kind not in ("overlay", "registered"):
            raise OptionError("there is no pose to overlay; solve first")
        options = tuple(sorted((k, v) for k, v in query.items() if k not in ("rev", "stage")))
        key = (kind, id(pose), options)
        make = self._overlay if kind == "overlay" else self._registered
        return self._loader.cached("picture", key, lambda: (pose, make(entry, pose, query)))[1]

    def prerender(self) -> None:
        """Render the scan in its default display, in a thread; it is the first image that a page requests."""

        def render() -> None:
            try:
                self._scan({})
            except LadarregError as error:
                log.debug("there is nothing to render: %s", error)
            except Exception:  # a page that requests the image gets the error
                log.exception("the scan could not be rendered")

        threading.Thread(target=render, name="picture", daemon=True).start()

    def _scan(self, query: Mapping[str, str]) -> Picture:
        from ladarreg_core.inspection.pictures import Stretch, scan_picture

        view, show = self._view(query), query.get("show", "intensity")
        stretch = Stretch(
            low=_number(query, "low", 1.0),
            high=_number(query, "high", 99.5),
            gamma=_number(query, "gamma", 0.6),
            equalise=query.get("equalise") == "1",
        )
        key = ("scan", id(view), show, stretch)
        return self._loader.cached("picture", key, lambda: (view, _png(scan_picture(view, show, stretch))))[1]

    def _photo(self, entry: PhotoEntry) -> Picture:
        pixels = self._loader.viewable_photo(entry).pixels
        if pixels.shape[0] * pixels.shape[1] <= _JPEG_ABOVE_PIXELS:
            return _png(pixels)
        from PIL import Image

        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
        return _picture(buffer.getvalue(), "image/jpeg")

    def _overlay(self, entry: PhotoEntry, pose: PoseEntry, query: Mapping[str, str]) -> Picture:
        from ladarreg_core.inspection.pictures import scan_over_photo

        result = self._loader.registration(pose)
        show = query.get("show", "intensity")
        return _png(scan_over_photo(self._scan_or_raise(), result.camera, result.camera_from_scanner, show))

    def _registered(self, entry: PhotoEntry, pose: PoseEntry, query: Mapping[str, str]) -> Picture:
        from ladarreg_core.inspection.model_textures import texture_without_z_buffer
        from ladarreg_core.inspection.pictures import photo_over_scan
        from ladarreg_core.surface.texture import texture_scan

        scan, result, photo = self._scan_or_raise(), self._loader.registration(pose), self._loader.photo(entry)
        if query.get("z_buffer") == "0":
            texture = texture_without_z_buffer(scan, photo, result)
        else:
            texture = texture_scan(scan, photo, result.camera_from_scanner, camera=result.camera)
        return _png(photo_over_scan(self._view(query), texture))

    def _scan_or_raise(self) -> Scan:
        scan = self._loader.scan(self._session.document)
        if scan is None:
            raise OptionError("there is no scan; open one")
        return scan

    def _view(self, query: Mapping[str, str]) -> View:
        views = self._loader.views(self._session.document)
        if not views:
            raise OptionError("there is no scan; open one")
        index = query.get("view", "0")
        if not index.isdecimal() or len(index) > _MAX_DIGITS or int(index) >= len(views):
            raise OptionError(f"there is no view {index[:20]!r}; the scan has {len(views)}")
        return views[int(index)].view


def _number(query: Mapping[str, str], name: str, otherwise: float) -> float:
    try:
        return float(query.get(name, otherwise))
    except ValueError:
        raise OptionError(f"{name} is {query[name]!r}; it must be a number") from None


def _png(pixels: Any) -> Picture:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=1)
    return _picture(buffer.getvalue(), "image/png")


def _picture(data: bytes, media_type: str) -> Picture:
    return Picture(data, media_type, hashlib.sha256(data).hexdigest()[:16])
