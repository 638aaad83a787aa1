"""Bundles: the page's modules in one file for each entry, so that a slow link waits for few requests.

A module becomes a function that is called at once, in the order in which modules are evaluated anyway; what it exports
is kept by its path. That suffices for modules like the page's, which import and export names at their top, and never in
a circle: whatever else is written is refused. Nothing has to be built, and a source map leads back to the modules.
"""

from __future__ import annotations

import json
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

_IMPORT = re.compile(r'^import (?:\{([^}]*)\}|\* as (\w+)) from "(\.[^"]+)";$', re.M)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|class|function) (\w+)\b)", re.M)
_COMMENT = re.compile(r"^[ \t]*/\*\*.*?\*/[ \t]*$", re.M | re.S)
_LEFT = re.compile(r"^(?:import|export)\b.*$", re.M)
_DROPPED = "\0"
_DIGITS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"


@dataclass(frozen=True, slots=True)
class Bundle:
    """An entry with everything that it imports and an earlier bundle does not have."""

    text: str
    """The script; it exports `$modules`, the exports of all modules by their paths, earlier bundles' included."""
    source_map: str
    """Where each of its lines comes from, as JSON."""
    exports: Mapping[str, Sequence[str]]
    """The names that each of its modules exports, by path."""


def bundled(entries: Iterable[str], modules: Mapping[str, str], *, folder: str) -> dict[str, Bundle]:
    """Bundle entries, each without what an earlier one has.

    Args:
        entries: paths of the entries, in the order in which the page loads them.
        modules: text of every module, by path.
        folder: where the bundles are served, each by the path of its entry, beside the modules.

    Returns:
        The bundles, by the paths of their entries.

    Raises:
        ValueError: if a module does not exist, imports itself by a detour, or is written in a way that is not bundled.
    """
    found: dict[str, Bundle] = {}
    known: dict[str, Sequence[str]] = {}
    for entry in entries:
        before = next(reversed(found), None)
        head = "const $modules = {};" if before is None else f'import {{ $modules }} from "{_from(entry, before)}";'
        lines: list[tuple[str, str, int]] = [(head, "", 0)]  # text, module and line there
        exports: dict[str, Sequence[str]] = {}
        for path in _in_order(entry, modules, known):
            body, names = _function(path, modules[path])
            lines += body
            exports[path] = names
        known |= exports
        lines += [("export { $modules };", "", 0), (f"//# sourceMappingURL={posixpath.basename(entry)}.map", "", 0)]
        text = "".join(f"{line}\n" for line, _, _ in lines)
        found[entry] = Bundle(text, _source_map(lines, _from(posixpath.join(folder, entry), "")), exports)
    return found


def re_exported(names: Sequence[str], path: str, bundle: str) -> str:
    """Return a module that exports what a bundled one does: the same objects.

    Args:
        names: what it exports.
        path: its path.
        bundle: URL of the bundle that has it.
    """
    return f'import {{ $modules }} from "{bundle}";\nexport const {{ {", ".join(names)} }} = $modules["{path}"];\n'


def imported_by(path: str, text: str) -> list[str]:
    """Return the paths of the modules that one imports, in its order."""
    return [posixpath.normpath(posixpath.join(posixpath.dirname(path), name)) for _, _, name in _IMPORT.findall(text)]


def _in_order(entry: str, modules: Mapping[str, str], known: Mapping[str, object]) -> list[str]:
    """Return an entry and what it needs besides what is known, in the order of their evaluation."""
    found: list[str] = []
    entered: set[str] = set()

    def visit(path: str, importer: str) -> None:
        if path in known or path in found:
            return
        if path not in modules:
            raise ValueError(f"{importer} imports {path}, which does not exist")
        if path in entered:
            raise ValueError(f"{path} imports itself, by {importer}: modules that import each other are not bundled")
        entered.add(path)
        for needed in imported_by(path, modules[path]):
            visit(needed, path)
        found.append(path)

    visit(entry, "the page")
    return found


def _function(path: str, text: str) -> tuple[list[tuple[str, str, int]], list[str]]:
    """Return a module as a function that is called: its lines with their numbers, and the names of its exports."""

    def required(found: re.Match[str]) -> str:
        names, whole, name = found.groups()
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), name))
        taken = whole or "{ " + ", ".join(each.replace(" as ", ": ") for each in _listed(names)) + " }"
        return f'const {taken} = $modules["{target}"];' + ("\n" + _DROPPED) * found[0].count("\n")

    plain = _COMMENT.sub(lambda found: "\n".join(_DROPPED for _ in found[0].split("\n")), text)
    plain = _IMPORT.sub(required, plain)
    names = _EXPORT.findall(plain)
    plain = _EXPORT.sub("", plain)
    left = _LEFT.search(plain)
    if left is not None or "$modules" in text:
        said = "the name $modules" if left is None else left[0]
        raise ValueError(
            f"{path} has {said!r}, which is not bundled; import and export names: import {{ a, b as c }} from "
            '"./x.js"; import * as x from "./x.js"; export const, class or function'
        )
    body = [(line, path, number) for number, line in enumerate(plain.split("\n")) if line != _DROPPED]
    head = (f'$modules["{path}"] = (() => {{', "", 0)
    return [head, *body, (f"return {{ {', '.join(names)} }};", "", 0), ("})();", "", 0)], names


def _listed(names: str) -> list[str]:
    return [each for each in (" ".join(name.split()) for name in names.split(",")) if each]


def _from(path: str, target: str) -> str:
    """Return a relative URL of a target, from a file in the same folder."""
    found = posixpath.relpath(target or ".", posixpath.dirname(path) or ".")
    return found if found.startswith(".") else f"./{found}"


def _source_map(lines: Sequence[tuple[str, str, int]], up: str) -> str:
    """Return the map of a bundle, line by line.

    Args:
        lines: of the bundle: text, module and line there; without a module where there is none.
        up: relative URL of the folder that the paths of the modules begin at.
    """
    numbers = {path: number for number, path in enumerate(dict.fromkeys(path for _, path, _ in lines if path))}
    mapped, last = [], (0, 0)
    for _, path, line in lines:
        here = (numbers[path], line) if path else last
        mapped.append(f"A{_vlq(here[0] - last[0])}{_vlq(here[1] - last[1])}A" if path else "")
        last = here
    sources = [f"{up}/{path}" for path in numbers]
    return json.dumps({"version": 3, "sources": sources, "names": [], "mappings": ";".join(mapped)})


def _vlq(value: int) -> str:
    """Return a number as source maps write it: digits of five bits, the lowest first, the sign in the lowest bit."""
    rest = abs(value) << 1 | (value < 0)
    digits = ""
    while True:
        digit, rest = rest & 31, rest >> 5
        digits += _DIGITS[digit | 32 * (rest > 0)]
        if not rest:
            return digits
