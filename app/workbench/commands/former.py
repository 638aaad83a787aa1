"""Commands of earlier versions, for scripts that send them: each has a present form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_OF_EXPORTS = ("frame", "last_solved", "folder", "force")
_STATIONS = {"targets": ["stations", "e57"], "photos": []}


def present_form(message: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a message in the form of this version; one that is in it already is returned as it is."""
    do, job = message.get("do"), message.get("job")
    if do == "run" and job == "report":
        return {**_head(message), "do": "write_report", "photo": message.get("photo")}
    if do == "export_folder" or (do == "run" and job == "export"):
        named = {name: message[name] for name in _OF_EXPORTS if name in message}
        folder = {"folder": message.get("folder", "")} if do == "export_folder" else {}
        return {
            **_head(message),
            "do": "export",
            "targets": ["results"],
            "photos": [message.get("photo")],
            **named,
            **folder,
        }
    if do == "hand_over":
        return {**message, "do": "export"}
    if do == "export_stations":
        return {**_head(message), "do": "export", **_STATIONS}
    return message


def _head(message: Mapping[str, Any]) -> dict[str, Any]:
    return {name: message[name] for name in ("id", "project") if name in message}
