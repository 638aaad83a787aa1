"""The log of a run: every exchange with its devices, one JSON object a line, for finding a fault the next day."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from ladarreg_core.acquisition.devices.link import Exchange

EXCHANGES, EXCHANGES_BEFORE = "exchanges.jsonl", "exchanges-before.jsonl"
"""The log, and its earlier part once it has become too long."""
_LOG = logging.getLogger(__name__)
_MAX_BYTES = 64 << 20
_SHOWN_BYTES = 160  # of an exchange; a scanner's lines are in the pieces


class ExchangeLog:
    """Appends exchanges to the log of a run; may be used from any thread. A log that cannot be written ends no run.

    Args:
        folder: of the run.
        most_bytes: length beyond which a new file is begun.
    """

    def __init__(self, folder: Path, *, most_bytes: int = _MAX_BYTES) -> None:
        self._folder, self._most_bytes = folder, most_bytes
        self._one = threading.Lock()
        self._file: IO[str] | None = None
        self._ended = False

    def add(self, device: str, exchange: Exchange) -> None:
        """Append an exchange with a device."""
        fields: dict[str, Any] = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "device": device}
        if exchange.remark:
            fields["remark"] = exchange.remark
        else:
            fields |= {
                "sent": _text(exchange.request), "received": _text(exchange.reply), "bytes": len(exchange.reply),
                "seconds": round(exchange.seconds, 4),
            }  # fmt: skip
        with self._one:
            try:
                self._append(json.dumps(fields) + "\n")
            except (OSError, ValueError) as error:
                _LOG.warning("the exchanges with the devices are no longer logged: %s", error)
                self._ended = True

    def close(self) -> None:
        """Close the file."""
        with self._one, contextlib.suppress(OSError):
            if self._file is not None:
                self._file.close()
            self._ended = True

    def _append(self, line: str) -> None:
        if self._ended:
            return
        if self._file is not None and self._file.tell() > self._most_bytes:
            self._file.close()
            self._file = None
            os.replace(self._folder / EXCHANGES, self._folder / EXCHANGES_BEFORE)
        if self._file is None:
            self._file = open(self._folder / EXCHANGES, "a", encoding="utf-8", buffering=1)  # noqa: SIM115
        self._file.write(line)


def _text(data: bytes) -> str:
    shown = data[:_SHOWN_BYTES].decode("ascii", "backslashreplace")
    return shown + "..." if len(data) > _SHOWN_BYTES else shown
