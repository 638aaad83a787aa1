"""The picture of a project in a list: its scan beside its first photograph."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from ladarreg_core.errors import LadarregError

from ...session.loader import Loader
from .images import Images

if TYPE_CHECKING:
    from PIL.Image import Image

    from ladarreg_core.project.document import Document

_HALF = (200, 150)
_QUALITY = 80


def draw_thumbnail(document: Document, loader: Loader, images: Images) -> bytes | None:
    """Return the picture, JPEG; None if nothing can be shown."""
    from PIL import Image, ImageOps

    halves: list[Image.Image] = []
    try:
        if document.scan is not None:
            halves.append(Image.open(io.BytesIO(images.picture("scan", {}).data)))
        if document.photos:
            halves.append(Image.fromarray(loader.viewable_photo(document.photos[0]).pixels))
    except LadarregError:
        if not halves:
            return None
    if not halves:
        return None
    whole = Image.new("RGB", (_HALF[0] * len(halves), _HALF[1]))
    for k, half in enumerate(halves):
        whole.paste(ImageOps.fit(half.convert("RGB"), _HALF), (k * _HALF[0], 0))
    buffer = io.BytesIO()
    whole.save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()
