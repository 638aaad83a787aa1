"""Pictures embedded in the scan's file, which offer themselves as photographs."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project import edits
from ladarreg_core.project.document import CameraGiven, Document, PhotoEntry
from ladarreg_core.project.source import Source

from ...session.isolated_readers import READERS
from ...session.loader import Loader
from ...session.session import Session
from ..state.clients import Client
from ..state.selection import Selection

if TYPE_CHECKING:
    from ladarreg_core.formats.e57_images import EmbeddedImage

    from ...slices.project import EmbeddedPicture


class EmbeddedPictures:
    """The pictures in the file of the present scan.

    Args:
        session: the session.
        loader: its loader.
        selection: the photograph that each client sees.
    """

    def __init__(self, session: Session, loader: Loader, selection: Selection) -> None:
        self._session, self._loader, self._selection = session, loader, selection
        self._listed: tuple[Source | None, tuple[EmbeddedImage, ...]] = (None, ())

    def slice(self) -> list[EmbeddedPicture]:
        """Return the slice `embedded`."""
        document = self._session.document
        taken = {photo.source.name for photo in document.photos}
        return [
            {
                "index": index,
                "name": image.name,
                "said": image.said,
                "usable": image.is_usable,
                "taken": image.name in taken,
            }
            for index, image in enumerate(self._images(document.scan))
        ]

    def add(self, indices: Sequence[int], client: Client) -> list[str]:
        """Add pictures as photographs, with the cameras that the scan's file states; return their ids.

        Raises:
            LadarregError: if there is no such picture, or it cannot be read; those before it were added.
        """
        return [self._add(index, client) for index in dict.fromkeys(indices)]

    def _images(self, scan: Source | None) -> tuple[EmbeddedImage, ...]:
        source, images = self._listed
        if scan != source:
            images = () if scan is None else self._read(scan)
            self._listed = (scan, images)
        return images

    def _read(self, scan: Source) -> tuple[EmbeddedImage, ...]:
        from ladarreg_core.formats.e57_images import embedded_images

        try:
            return READERS.run(embedded_images, self._session.folder.source_path(scan.path), scan.index)
        except LadarregError:  # the slice `scan` says what is wrong with the file
            return ()

    def _add(self, index: int, client: Client) -> str:
        from ladarreg_core.formats.cameras.camera_file import write_camera
        from ladarreg_core.formats.e57_images import embedded_data

        scan = self._session.document.scan
        images = self._images(scan)
        if scan is None or not 0 <= index < len(images):
            raise OptionError("the scan has no such picture; reload the page")
        image, folder = images[index], self._session.folder
        if not image.is_usable:
            raise OptionError(f"{image.name} cannot be a photograph: {image.said}; choose another")
        data = READERS.run(embedded_data, folder.source_path(scan.path), index)
        path = folder.inputs / f"{secrets.token_hex(16)}{Path(image.name).suffix}"
        beside = path.with_suffix(".json")
        try:
            path.write_bytes(data.tobytes())
            camera = CameraGiven()
            if image.camera is not None:
                write_camera(beside, image.camera)
                name = f"camera of {image.name}"
                file = Source(path=folder.relative(beside), name=name, size=beside.stat().st_size)
                camera = CameraGiven(file=file)
            source = Source(path=folder.relative(path), name=image.name, size=path.stat().st_size)
            self._loader.preload_photo(PhotoEntry(id="trial", source=source, camera=camera))
        except BaseException:
            path.unlink(missing_ok=True)
            beside.unlink(missing_ok=True)
            raise
        made = ""
        pose = image.camera_from_scanner
        stated = None if pose is None else tuple(tuple(map(float, row)) for row in pose.matrix)

        def edit(document: Document) -> Document:
            nonlocal made
            document, made = edits.with_photo(document, source, camera, stated_pose=stated)
            return document

        self._session.commit(f"Open {image.name} of the scan", edit, author=client.author)
        self._selection.show(client, made)
        return made
