"""Summary of a log as Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from benchmarks.abuse.log import Row, read_rows, rows_of

P99_MS, MEMORY_MB, GROWTH_MB = 50.0, 1024.0, 50.0
"""Limits: latency of other clients' edits (p99), memory of one flood or file, growth after ten minutes."""
_FAULTS_SHOWN = 5


def summary(path: Path) -> str:
    """Return the tables of a log."""
    rows = read_rows(path)
    parts = [_heading(rows), *(part for table in _TABLES if (part := table(rows)))]
    return "\n\n".join(parts) + "\n"


def _heading(rows: list[Row]) -> str:
    machines = rows_of(rows, "machine")
    if not machines:
        return "An empty log."
    last = machines[-1]
    commits = ", ".join(dict.fromkeys(str(row["commit"]) for row in machines))
    return (
        f"Commit {commits}; Python {last['python']}, {last['system']}, {last['processors']} processors; "
        f"from {rows[0]['when'][:16]} to {rows[-1]['when'][:16]}."
    )


def _table(head: Iterable[str], body: Iterable[Iterable[object]]) -> str:
    lines = ["| " + " | ".join(head) + " |"]
    lines.append("|" + "---|" * lines[0].count(" | ") + "---|")
    lines += ["| " + " | ".join("-" if cell is None else str(cell) for cell in row) + " |" for row in body]
    return "\n".join(lines)


def _listed(faults: Iterable[str]) -> str:
    """Return the most frequent kinds of fault as a list, each with its first example."""
    kinds: Counter[str] = Counter()
    first: dict[str, str] = {}
    for fault in faults:
        kind = "".join("#" if c.isdigit() else c for c in fault)[:120]
        kinds[kind] += 1
        first.setdefault(kind, fault)
    shown = [
        f"- {kinds[kind]} x `{first[kind][:260].replace('`', '')}`" for kind, _ in kinds.most_common(_FAULTS_SHOWN)
    ]
    if len(kinds) > _FAULTS_SHOWN:
        shown.append(f"- and {len(kinds) - _FAULTS_SHOWN} more kinds")
    return "\n".join(shown)


def _section(title: str, text: str, faults: Iterable[str]) -> str:
    listed = _listed(faults)
    return "\n\n".join(part for part in (f"### {title}", text, listed) if part)


def _readers(rows: list[Row]) -> str:
    found = rows_of(rows, "readers")
    if not found:
        return ""
    body = []
    for name in dict.fromkeys(row["format"] for row in found):
        own = [row for row in found if row["format"] == name]
        body.append(
            (
                name, _sum(own, "files"), _sum(own, "refused"), f"{max(row['seconds'] for row in own):.2f}",
                f"{max(row['mb'] for row in own):.0f}", _sum(own, "count"),
            )
        )  # fmt: skip
    head = ("format", "damaged files", "refused", "slowest, s", "largest, MB", "failures")
    return _section("Damaged files", _table(head, body), _all(found, "faults"))


def _protocol(rows: list[Row]) -> str:
    found = rows_of(rows, "protocol")
    if not found:
        return ""
    head = ("hostile messages", "done", "refused", "connections closed", "slowest, s", "failures")
    body = (*(_sum(found, name) for name in ("messages", "done", "refused", "closed")),
            max(row["seconds"] for row in found), _sum(found, "count"))  # fmt: skip
    return _section("Hostile messages", _table(head, [body]), _all(found, "faults"))


def _kills(rows: list[Row]) -> str:
    found = rows_of(rows, "kills")
    if not found:
        return ""
    body = (len(found), _sum(found, "answered"), sum(bool(row["lost"]) for row in found), _sum(found, "count"))
    head = ("kills", "edits answered", "kills that lost some", "edits lost")
    return _section("Kills while three clients edit", _table(head, [body]), _all(found, "lost"))


def _signals(rows: list[Row]) -> str:
    found = rows_of(rows, "signals")
    if not found:
        return ""
    body = (len(found), _sum(found, "answered"), sum(bool(row["faults"]) for row in found))
    return _section("Two stop signals", _table(("pairs", "edits answered", "failures"), [body]), _all(found, "faults"))


def _disks(rows: list[Row]) -> str:
    found = rows_of(rows, "disks")
    if not found:
        return ""
    body = []
    for disk, ends in dict.fromkeys((row["disk"], row["ends"]) for row in found):
        own = [row for row in found if (row["disk"], row["ends"]) == (disk, ends)]
        what = "a disk in memory" if disk == "MountedDisk" else "a limit of file sizes"
        failed = sum(bool(row["lost"]) for row in own)
        body.append((what, _ENDS.get(ends, ends), len(own), _sum(own, "saved"), _sum(own, "unsaved"), failed))
    head = ("disk", "then", "times", "edits answered as saved", "as not saved", "failures")
    return _section("Full disks", _table(head, body), _all(found, "lost"))


_ENDS = {
    "torn": "room at once, five edits, killed", "kill": "five refused, room, five edits, killed",
    "wait": "room, no edits, killed", "stop": "stopped while full",
}  # fmt: skip


def _damage(rows: list[Row]) -> str:
    found = rows_of(rows, "damage")
    if not found:
        return ""
    names = {"flips": "one bit flipped", "missing": "one file missing or empty"}
    body = []
    for kind in dict.fromkeys(row["kind"] for row in found):
        own = [row for row in found if row["kind"] == kind]
        body.append((names[kind], _sum(own, "tried"), _sum(own, "hurt")))
    head = ("damage", "projects", "lost more than it hit")
    return _section("Damaged projects", _table(head, body), _all(found, "losses"))


def _faults(rows: list[Row]) -> str:
    found = rows_of(rows, "faults")
    if not found:
        return ""
    counts = ("rounds", "ended", "crashed", "wrong")
    names = {"calls": "a call fails", "power": "power is lost", "memory": "memory ends"}
    body = []
    for case in dict.fromkeys(row["case"] for row in found):
        for kind, what in names.items():
            own = [row for row in found if (row["case"], row["kind"]) == (case, kind)]
            if own:
                body.append((case, what, *(_sum(own, name) for name in counts)))
    body += [
        ("all", what, *(_sum(rows_of(found, "faults", {"kind": kind}), name) for name in counts))
        for kind, what in names.items()
    ]
    head = ("work", "what fails", "rounds", "ended early", "of these by a crash of NumPy",
            "neither old nor new, or no clear sentence")  # fmt: skip
    return _section("Calls that fail", _table(head, body), _all(found, "first"))


def _hostile(rows: list[Row]) -> str:
    found = rows_of(rows, "hostile")
    if not found:
        return ""
    head = ("hostile files", "heard by a listener", "confined and traced", "connections", "foreign files opened")
    body = [(row["files"], row["heard"], row["confined"], row["connects"], row["foreign"]) for row in found]
    return _section("Hostile files", _table(head, body), _all(found, "faults"))


def _forced(rows: list[Row]) -> str:
    found = rows_of(rows, "forced")
    if not found:
        return ""
    names = ("runs", "refused", "replaced", "others", "count")
    body = [(row["command"], *(row[name] for name in names)) for row in found]
    body.append(("all", *(_sum(found, name) for name in names)))
    head = ("command with --force", "runs", "refused", "replaced its own", "ended otherwise", "foreign files lost")
    return _section("--force beside foreign files", _table(head, body), _all(found, "lost"))


def _floods(rows: list[Row]) -> str:
    found = rows_of(rows, "floods")
    if not found:
        return ""
    body = []
    for row in found:
        met = row["p99_ms"] is not None and row["p99_ms"] <= P99_MS and not row["unsaved"] and not row["shut_out"]
        grown = None if row["base_mb"] is None else round(row["peak_mb"] - row["base_mb"])
        met = met and grown is not None and grown <= MEMORY_MB and row["joins_after"] and not row["failures"]
        kept = None if row["after_mb"] is None else round(row["after_mb"] - row["base_mb"])
        newcomers = f"{row['newcomers'] - row['shut_out']} of {row['newcomers']}"
        body.append(
            (
                row["flood"], row["edits"], row["p50_ms"], row["p99_ms"], row["worst_ms"], row["unsaved"], newcomers,
                grown, kept, row.get("descriptors"), "yes" if row["joins_after"] else "NO", "met" if met else "MISSED",
            )
        )  # fmt: skip
    head = ("flood", "edits of another client", "median, ms", f"p99, ms (<= {P99_MS:g})", "worst, ms", "not saved",
            "newcomers let in", "peak, MB more", "afterwards, MB more", "descriptors, most",
            "a page opens afterwards", "")  # fmt: skip
    answers = [f"{row['flood']}: {answer}" for row in found for answer in _answers(row)]
    return _section("Floods", _table(head, body), [*_all(found, "failures")]) + (
        "\n\n" + "\n".join(f"- {line[:300]}" for line in answers) if answers else ""
    )


def _answers(row: Row) -> list[str]:
    attack = dict(row.get("attack") or {})
    answers = list(dict.fromkeys(attack.pop("answers", [])))
    counts = ", ".join(f"{name} {value}" for name, value in attack.items())
    return [*answers, *([counts] if counts else [])]


def _clients(rows: list[Row]) -> str:
    found = [row for row in rows_of(rows, "clients") if row.get("mb") is not None]
    if not found:
        return ""
    body = []
    for part in dict.fromkeys(row["part"] for row in found):
        own = [row for row in found if row["part"] == part]
        first, last = own[0], own[-1]
        highest = max(row["mb"] for row in own)
        met = "met" if highest - first["mb"] <= GROWTH_MB else "MISSED"
        slow = max((row["p99_ms"] for row in own if row["p99_ms"] is not None), default=None)
        hours = f"{last['hours']:.2f}" + (f" (from {first['hours']:.2f})" if part else "")
        body.append(
            (hours, f"{last['pace']:g}", last["edits"], last["unsaved"], first["mb"], last["mb"], highest, met, slow)
        )
    head = ("hours of ten clients", "pace", "edits", "not saved", "MB after ten minutes", "MB at the end",
            "highest, MB",
            f"growth <= {GROWTH_MB:g} MB", "highest p99, ms")  # fmt: skip
    return _section("Ten clients at work", _table(head, body), _all(rows_of(rows, "clients"), "faults"))


def _sum(rows: list[Row], name: str) -> Any:
    return sum(row.get(name) or 0 for row in rows)


def _all(rows: list[Row], name: str) -> list[str]:
    return [text for row in rows for text in row.get(name) or ()]


_TABLES: tuple[Callable[[list[Row]], str], ...] = (
    _readers, _protocol, _kills, _signals, _disks, _damage, _faults, _hostile, _forced, _floods, _clients,
)  # fmt: skip
