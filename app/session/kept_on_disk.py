"""Values made of a project's files, kept on disk between runs of the program."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

if TYPE_CHECKING:
    from ladarreg_core.project.document import PhotoEntry
    from ladarreg_core.project.source import Source
    from ladarreg_core.project.storage.folder import ProjectFolder

T = TypeVar("T")


class KeptOnDisk:
    """Plain values and arrays by the files that they are made of, as these are now.

    Args:
        folder: the project's folder.
    """

    def __init__(self, folder: ProjectFolder) -> None:
        self._folder = folder

    def get(
        self,
        kind: str,
        files: Sequence[Source],
        made_of: Mapping[str, Any],
        make: Callable[[], T],
        *,
        is_sound: Callable[[Any], Any] = lambda value: value is not None,
    ) -> T:
        """Return a value; make it where it is not kept, or not sound.

        Args:
            kind: what it is.
            files: the files that it is made of.
            made_of: what else it is made of, plain JSON values.
            make: makes it.
            is_sound: returns whether what was kept can be used.
        """
        from ladarreg_core.batches.photos.cache import ContentCache
        from ladarreg_core.export.json import plain

        try:
            stats = [path.stat() for file in files for path in self._folder.source_files(file)]
        except OSError:
            return make()
        kept = ContentCache.of_user()
        key = ContentCache.key(
            kind=kind, files=[[one.st_size, one.st_mtime_ns, one.st_ino] for one in stats],
            sources=plain(msgspec.to_builtins(list(files))), folder=str(self._folder.path), **made_of,
        )  # fmt: skip
        known = kept.get(key)
        if known is not None and is_sound(known):
            return known  # type: ignore[no-any-return]
        found = make()
        kept.put(key, found)
        return found

    def of_photo(self, kind: str, entry: PhotoEntry, make: Callable[[], T], *, is_sound: Callable[[Any], Any]) -> T:
        """Return a value made of a photograph and its camera."""
        from ladarreg_core.export.json import plain

        files = [entry.source, *([entry.camera.file] if entry.camera.file else [])]
        return self.get(kind, files, {"camera": plain(msgspec.to_builtins(entry.camera))}, make, is_sound=is_sound)
