"""The two tokens of a port or Unix socket, kept with the user's data so that links and open pages outlive a restart."""

from __future__ import annotations

import json
import logging
import os
import secrets
import stat
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from .login import MIN_TOKEN_LENGTH, new_token

log = logging.getLogger(__name__)
_FOLDER_MODE = 0o700
_FILE_MODE = 0o600
_MAX_BYTES = 4096


@dataclass(frozen=True, slots=True)
class Tokens:
    """Access to a workbench."""

    edit: str
    """Grants everything."""
    look: str
    """Grants looking only; empty: nothing does."""


def kept_tokens(folder: Path, where: int | str | None, *, chosen: str | None = None, renew: bool = False) -> Tokens:
    """Return the tokens of a place to listen: those of the last time, or new ones, which are kept.

    A file that others can read, or that belongs to somebody else, is not trusted: its tokens are replaced. If the
    folder cannot be written, new tokens apply to this start only.

    Args:
        folder: the folder for tokens.
        where: the port, or a name of the Unix socket; None: any port, for which tokens are not kept.
        chosen: the operator's own token, which is not kept; None: the kept one.
        renew: replace the kept tokens.
    """
    path = folder / f"{where}.json"
    kept = None if renew or where is None else _read(path)
    if kept is None:
        kept = Tokens(new_token(), new_token())
        if where is not None:
            try:
                _write(path, kept)
            except OSError as error:
                log.warning("the tokens are not kept: %s", error)
    return kept if chosen is None else Tokens(chosen, kept.look)


def _read(path: Path) -> Tokens | None:
    try:
        with path.open("rb") as file:
            if not _is_private(os.fstat(file.fileno())):
                return None
            fields = json.loads(file.read(_MAX_BYTES))
        tokens = Tokens(fields["edit"], fields["look"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    whole = all(isinstance(token, str) and len(token) >= MIN_TOKEN_LENGTH for token in (tokens.edit, tokens.look))
    return tokens if whole and tokens.edit != tokens.look else None


def _is_private(status: os.stat_result) -> bool:
    """Return whether only this user can read and write a file; on Windows the user's data are private."""
    if os.name == "nt":
        return True
    return stat.S_ISREG(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077


def _write(path: Path, tokens: Tokens) -> None:
    path.parent.mkdir(parents=True, exist_ok=True, mode=_FOLDER_MODE)
    part = path.with_name(f".{path.stem}.{secrets.token_hex(8)}.part")
    text = json.dumps({"edit": tokens.edit, "look": tokens.look}).encode()
    try:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _FILE_MODE)
        with os.fdopen(descriptor, "wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
