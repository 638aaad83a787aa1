"""The manifest of a folder of results: `.ladarreg-manifest.json` lists its files with their sizes and SHA-256."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.errors import FormatError
from ladarreg_core.storage.atomic_write import files_below, replaced_file, write_bytes
from ladarreg_core.storage.checksums import CHECKSUM_FIELD, checksum_state, sealed

MANIFEST_FILE = ".ladarreg-manifest.json"
"""Name of the manifest."""
DOCUMENTS = ("registration.json", "stations.json", "rig.json", "export.json", "adjustment.json", "batch.json")
"""The documents of results that hold their own checksum."""
_VERSION = 1
_LARGEST_BYTES = 32 << 20
_LARGEST_DOCUMENT_BYTES = 8_000_000
_READ_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class ListedFile:
    """A file of a manifest."""

    name: str
    """Its name, with `/` between folders."""
    size: int
    sha256: str
    document_sha256: str | None = None
    """The checksum that a document of results holds itself: one that was only reformatted is no other document."""

    @staticmethod
    def of(path: Path, name: str) -> ListedFile:
        """Return the entry of a file.

        Raises:
            OSError: if it cannot be read.
        """
        digest, size = hashlib.sha256(), 0
        with open(path, "rb") as file:
            while block := file.read(_READ_BYTES):
                digest.update(block)
                size += len(block)
        own = _own_checksum(path) if name.rpartition("/")[2] in DOCUMENTS else None
        return ListedFile(name, size, digest.hexdigest(), own)

    def as_fields(self) -> dict[str, Any]:
        """Return the entry as it is written."""
        own = {} if self.document_sha256 is None else {"document_sha256": self.document_sha256}
        return {"name": self.name, "size": self.size, "sha256": self.sha256, **own}

    def fault(self, folder: Path) -> str:
        """Return in what a file differs from its entry, after its name; empty: in nothing.

        Raises:
            OSError: if it cannot be read.
        """
        path = folder / self.name
        if not path.is_file():
            return "is missing"
        size = path.stat().st_size
        if size != self.size and self.document_sha256 is None:
            return f"has {size:,} bytes in place of {self.size:,}"
        found = ListedFile.of(path, self.name)
        same = found.sha256 == self.sha256 if self.document_sha256 is None else (
            found.document_sha256 == self.document_sha256
        )  # fmt: skip
        return "" if same else "is not what was written (another SHA-256)"


def manifest_bytes(files: Iterable[ListedFile]) -> bytes:
    """Return the contents of a manifest."""
    listed = [one.as_fields() for one in sorted(files, key=lambda one: one.name)]
    fields = sealed({"version": _VERSION, "kind": "manifest", "files": listed})
    return (json.dumps(fields, indent=1, ensure_ascii=False) + "\n").encode("utf-8")


def write_manifest(folder: Path) -> None:
    """Write the manifest of all files in and below a folder that is not in use yet.

    Raises:
        ExportError: if it cannot be written.
        OSError: if a file cannot be read.
    """
    found = [ListedFile.of(path, path.relative_to(folder).as_posix()) for path in files_below(folder)]
    write_bytes(folder / MANIFEST_FILE, manifest_bytes(one for one in found if one.name != MANIFEST_FILE))


def read_manifest(folder: Path) -> dict[str, ListedFile] | None:
    """Return the entries of a folder's manifest by their names; None: it has no manifest.

    Raises:
        FormatError: if it is damaged.
    """
    path = folder / MANIFEST_FILE
    try:
        if not path.is_file():
            return None
        if path.stat().st_size > _LARGEST_BYTES:
            raise ValueError("too large")
        fields = json.loads(path.read_bytes())
        if checksum_state(fields) != "intact" or fields["kind"] != "manifest":
            raise ValueError("another checksum")
        return {one["name"]: _listed(one) for one in fields["files"]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise FormatError(
            f"{MANIFEST_FILE}, which lists the files of the folder, is damaged; take the folder as it was written, or "
            "remove that file to do without it"
        ) from None


def update_manifest(folder: Path, names: Sequence[str]) -> None:
    """List files of a folder anew that the program itself has replaced; without a manifest nothing is done.

    Raises:
        FormatError: if the manifest is damaged.
        ExportError: if it cannot be written.
    """
    listed = read_manifest(folder)
    if listed is None:
        return
    listed |= {name: ListedFile.of(folder / name, name) for name in names}
    with replaced_file(folder / MANIFEST_FILE) as new:
        write_bytes(new, manifest_bytes(listed.values()))


def remove_listed(folder: Path, *, besides: Collection[str] = ()) -> None:
    """Remove the files that a folder's manifest lists and that are as they were written, and what is empty then.

    Args:
        folder: a folder; without a manifest nothing is done. Links in it are not followed.
        besides: names of files that stand in nobody's way, such as those of file managers, removed from these folders.

    Raises:
        FormatError: if the manifest is damaged.
        OSError: if a file cannot be read or removed.
    """
    listed = read_manifest(folder)
    if listed is None:
        return
    parents: set[Path] = set()
    for one in listed.values():
        path = folder / one.name
        above = [parent for parent in path.parents if folder in parent.parents]
        if any(part.is_symlink() for part in (path, *above)):
            continue
        parents.update(above)
        if not one.fault(folder):
            path.unlink()
    if all(name in (MANIFEST_FILE, *besides) or folder / name in parents for name in os.listdir(folder)):
        besides = (*besides, MANIFEST_FILE)  # with the last file
    for parent in sorted({*parents, folder}, key=lambda path: -len(path.parts)):
        left = set(os.listdir(parent)) if parent.is_dir() else {""}
        if left <= {*besides}:
            for name in left:
                (parent / name).unlink()
            parent.rmdir()


def manifest_fault(file: Path) -> str:
    """Return in what a file differs from the manifest beside it; empty: in nothing, or it is not listed.

    Raises:
        FormatError: if the manifest is damaged.
        OSError: if the file cannot be read.
    """
    listed = (read_manifest(file.parent) or {}).get(file.name)
    return "" if listed is None else listed.fault(file.parent)


def visible_files(folder: Path) -> list[str]:
    """Return the names of a folder's files and folders, without the manifest."""
    return sorted(path.name for path in folder.iterdir() if path.name != MANIFEST_FILE)


def _listed(fields: Mapping[str, Any]) -> ListedFile:
    name, size, digest, own = (fields.get(key) for key in ("name", "size", "sha256", "document_sha256"))
    inside = isinstance(name, str) and all(part not in ("", ".", "..") for part in name.split("/"))
    if not inside or not isinstance(size, int) or not isinstance(digest, str) or {*"\\:\0"} & {*str(name)}:
        raise ValueError("an entry is damaged")
    return ListedFile(str(name), size, digest, own if isinstance(own, str) else None)


def _own_checksum(path: Path) -> str | None:
    """Return the checksum that a document holds, if it is right."""
    try:
        if path.stat().st_size > _LARGEST_DOCUMENT_BYTES:
            return None
        fields = json.loads(path.read_bytes())
        return str(fields[CHECKSUM_FIELD]) if checksum_state(fields) == "intact" else None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
