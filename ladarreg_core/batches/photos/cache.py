"""A cache of arrays on disk by content: bounded, shared by processes, and never trusted to be intact."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
from pathlib import Path
from typing import IO, Any

from ladarreg_core.formats.isolated.messages import MessageError, message_parts, read_message
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.foundations.version import VERSION
from ladarreg_core.storage.atomic_write import make_folder
from ladarreg_core.storage.checksums import checksum
from ladarreg_core.storage.staging import is_running

MAX_BYTES = 4_000_000_000
"""Default size of a cache."""
_SUFFIX, _PART = ".entry", ".part"
_NAME = re.compile(r"[0-9a-f]{64}\.entry")
_PARTIAL = re.compile(r"\.[0-9a-f]{64}\.(\d{1,10})-[0-9a-f]{8}\.part")
_DIGEST_BYTES = 32
_READ_BYTES = 1 << 20


class ContentCache:
    """Values by the SHA-256 of what they were made of, one file each.

    A value is what `isolated.messages` can write: plain values, arrays of numbers, a scan; nothing is unpickled. An
    entry is written aside and renamed, so that it is there as a whole or not at all, and starts with the checksum of
    its content: one that is damaged, cut off or of another program is removed, and counts as absent. Where nothing can
    be written, nothing is kept. When the files exceed the bound, those that were not used for longest are removed.
    Several processes may use the same folder.

    Args:
        folder: the folder, which is created when the first value is kept.
        most_bytes: size of all entries together; an entry that is larger by itself is not kept.

    Raises:
        OptionError: if the bound is no whole number, or negative.
    """

    def __init__(self, folder: str | Path, *, most_bytes: int = MAX_BYTES) -> None:
        self.folder = Path(folder)
        self.most_bytes = require_int(most_bytes, "the size of the cache", least=0)

    @staticmethod
    def of_user() -> ContentCache:
        """Return the cache of the user who runs the program."""
        import platformdirs

        return ContentCache(Path(platformdirs.user_cache_dir("ladarreg", appauthor=False), "content"))

    @staticmethod
    def key(**made_of: Any) -> str:
        """Return the key of a value: of the program's version and of all that it was made of, plain JSON values."""
        return checksum({"software": VERSION, **made_of})

    def __contains__(self, key: str) -> bool:
        return self._path(key).is_file()

    def get(self, key: str) -> Any:
        """Return the value of a key; None: it is not kept, or was damaged."""
        path = self._path(key)
        try:
            with open(path, "rb") as file:
                size = os.fstat(file.fileno()).st_size
                if file.read(_DIGEST_BYTES) != _digest_of_rest(file):
                    raise MessageError("another checksum")
                file.seek(_DIGEST_BYTES)
                value = read_message(file, largest_bytes=size)
            os.utime(path)  # it was used
        except FileNotFoundError:
            return None
        except (OSError, EOFError, MessageError):
            with contextlib.suppress(OSError):
                path.unlink()
            return None
        return value

    def put(self, key: str, value: Any) -> None:
        """Keep a value, if there is room for it.

        Raises:
            TypeError: if the value contains anything that cannot be kept.
        """
        parts = message_parts(value)
        size = _DIGEST_BYTES + sum(part.nbytes for part in parts)
        if size > self.most_bytes:
            return
        part = self.folder / f".{key}.{os.getpid()}-{secrets.token_hex(4)}{_PART}"
        try:
            make_folder(self.folder)
            digest = hashlib.sha256()
            with open(part, "wb") as file:
                file.write(bytes(_DIGEST_BYTES))
                for data in parts:
                    file.write(data)
                    digest.update(data)
                file.seek(0)
                file.write(digest.digest())
            self._make_room(size)
            os.replace(part, self._path(key))
        except OSError:  # a full disk: it is made again where it is needed
            return
        finally:
            with contextlib.suppress(OSError):
                part.unlink()

    def clear(self) -> None:
        """Remove all entries, and the folder if nothing else is in it."""
        with contextlib.suppress(OSError):
            for entry in os.scandir(self.folder):
                if _NAME.fullmatch(entry.name) or _PARTIAL.fullmatch(entry.name):
                    os.unlink(entry.path)
            self.folder.rmdir()

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}{_SUFFIX}"

    def _make_room(self, size: int) -> None:
        """Remove entries, those first that were not used for longest, until one of a size fits; and old partial ones.

        Raises:
            OSError: if the folder cannot be listed.
        """
        entries = []
        with os.scandir(self.folder) as listed:
            for entry in listed:
                with contextlib.suppress(OSError):
                    if _NAME.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                        state = entry.stat()
                        entries.append((state.st_mtime_ns, state.st_size, entry.path))
                    elif (partial := _PARTIAL.fullmatch(entry.name)) and not is_running(int(partial[1])):
                        os.unlink(entry.path)
        total = sum(held for _, held, _ in entries)
        for _, held, path in sorted(entries):
            if total + size <= self.most_bytes:
                return
            with contextlib.suppress(OSError):
                os.unlink(path)
                total -= held


def _digest_of_rest(file: IO[bytes]) -> bytes:
    digest = hashlib.sha256()
    while block := file.read(_READ_BYTES):
        digest.update(block)
    return digest.digest()
