"""Reads the fields of a plan: each that is wrong becomes a fault, and reading goes on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ladarreg_core.acquisition.plan import PlanFault
from ladarreg_core.acquisition.twin_address import check_twin, is_twin
from ladarreg_core.errors import DeviceError


class FieldReader:
    """Reads fields and collects faults; a field with one is read as None.

    Args:
        folders_exist: whether the watched folders must be there.
    """

    def __init__(self, *, folders_exist: bool) -> None:
        self.faults: list[PlanFault] = []
        self._folders_exist = folders_exist

    def _fault(self, field: str, text: str) -> None:
        self.faults.append(PlanFault(field, text))

    def _object(self, value: Any, name: str) -> Mapping[str, Any] | None:
        if isinstance(value, Mapping):
            return value
        self._fault(name, f"{name!r} is {'missing' if value is None else shown(value)}; it must be an object")
        return None

    def _refuse_unknown(self, fields: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
        for key in fields:
            if key not in known:
                near = get_close_matches(str(key), known, n=1)
                wanted = f"did you mean {near[0]!r}?" if near else f"use {', '.join(known)}"
                self._fault(_field(where), f"{where} has an unknown key {shown(key)}; {wanted}")

    def _choice(
        self, fields: Mapping[str, Any], name: str, choices: tuple[str, ...], default: str | None, where: str
    ) -> str | None:
        value = fields.get(name, default)
        if isinstance(value, str) and value in choices:
            return value
        found = "missing" if value is None else shown(value)
        self._fault(
            _field(where, name), f"{name!r} of {where} is {found}; it must be {' or '.join(map(repr, choices))}"
        )
        return None

    def _text(self, fields: Mapping[str, Any], name: str, where: str, example: str) -> str | None:
        value = fields.get(name)
        if isinstance(value, str) and value.strip():
            return value.strip()
        self._fault(
            _field(where, name),
            f"{name!r} of {where} is {'missing' if value is None else shown(value)}; give {example}",
        )
        return None

    def _folder(self, fields: Mapping[str, Any], where: str) -> str | None:
        folder = self._text(fields, "folder", where, "the folder that its software writes to")
        if folder is not None and is_twin(folder):
            self._check_twin(fields, "folder", where)
        elif folder is not None and self._folders_exist and not Path(folder).expanduser().is_dir():
            self._fault(
                _field(where, "folder"),
                f"'folder' of {where} is {shown(folder)}, which does not exist; create or correct it",
            )
        return folder

    def _check_twin(self, fields: Mapping[str, Any], name: str, where: str) -> None:
        try:
            check_twin(fields[name].strip())
        except DeviceError as error:
            self._fault(_field(where, name), f"{name!r} of {where}: {error}")

    def _flag(self, fields: Mapping[str, Any], name: str) -> bool:
        value = fields.get(name, False)
        if not isinstance(value, bool):
            self._fault(name, f"{name!r} is {shown(value)}; it must be true or false")
            return False
        return value

    def _whole(
        self, fields: Mapping[str, Any], name: str, default: int, least: int, most: int, where: str
    ) -> int | None:
        value = fields.get(name, default)
        if type(value) is int and least <= value <= most:
            return value
        self._fault(
            _field(where, name),
            f"{name!r} of {where} is {shown(value)}; it must be a whole number from {least} to {most}",
        )
        return None

    def _number(
        self, fields: Mapping[str, Any], name: str, default: float, least: float, most: float, where: str
    ) -> float | None:
        if fields.get(name) is None:
            return default
        value = fields[name]
        if type(value) in (int, float) and least <= value <= most:  # NaN is neither
            return float(value)
        self._fault(
            _field(where, name),
            f"{name!r} of {where} is {shown(value)}; it must be a number from {least:g} to {most:g}",
        )
        return None


def _field(where: str, name: str = "") -> str:
    """Return the field that `where` means in messages: `the plan`, `'unit'` or `'scanner' of kind ...`, and its key."""
    part = where.split("'")[1] if "'" in where else ""
    return ".".join(filter(None, (part, name)))


def are_numbers(value: Any, count: int, least: float, most: float) -> bool:
    """Return whether a value is a list of finite numbers within limits."""
    return (
        isinstance(value, list | tuple)
        and len(value) == count
        and all(type(v) in (int, float) and least <= v <= most for v in value)
    )


def shown(value: Any) -> str:
    """Return a value for messages, shortened."""
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=repr)
    return text if len(text) <= 60 else text[:57] + "..."
