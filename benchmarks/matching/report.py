"""Report on the rows of automatic matching: sections with their bars."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.matching.rig_sets import rig_section
from benchmarks.matching.sets import WITH_PEERS
from benchmarks.matching.sparse_peers import PEERS_SET
from benchmarks.matching.sparse_report import sparse_sections
from benchmarks.pose.report import NOTHING, Bar, Section, as_markdown, number, table
from benchmarks.register import METHODS, Row

RIGHT_PX = 2.0
"""Error beyond which an accepted pose counts as wrong."""
_MARKERS = ("<!-- matching: begin -->", "<!-- matching: end -->")
_SPARSE_MARKERS = ("<!-- sparse: begin -->", "<!-- sparse: end -->")
_PEERS_MARKERS = ("<!-- sparse peers: begin -->", "<!-- sparse peers: end -->")
_RIG_MARKERS = ("<!-- rigs: begin -->", "<!-- rigs: end -->")
_NO_RIGHT_ANSWER = ("wrong", "near", "blank", "thermal wrong")


def sections(rows: Sequence[Row]) -> list[Section]:
    """Return the sections for these rows."""
    asks = (_peers_section, _intrinsics_section, _thermal_section, _refusals_section, _real_section, _times_section)
    return [
        *(section for ask in asks if (section := ask(rows)) is not None),
        *sparse_sections(rows),
        *_rig_sections(rows),
    ]


def seeds_of(section: Section, rows: Sequence[Row]) -> list[int]:
    """Return the seeds of a section."""
    return sorted({row.seed for row in rows if row.set_name in section.figures["sets"]})


def write_page(path: Path, rows: Sequence[Row]) -> None:
    """Replace the sections between the markers of a page; everything else stays, and so do sets that were not run."""
    text = path.read_text(encoding="utf-8")
    sparse, rigs = sparse_sections(rows), _rig_sections(rows)
    elsewhere = {section.key for section in (*sparse, *rigs)}
    peers = [section for section in sparse if section.key == PEERS_SET]
    sparse = [section for section in sparse if section.key != PEERS_SET]
    rooms = [section for section in sections(rows) if section.key not in elsewhere]
    for (first, last), mine in (
        (_MARKERS, rooms),
        (_SPARSE_MARKERS, sparse),
        (_PEERS_MARKERS, peers),
        (_RIG_MARKERS, rigs),
    ):
        if not mine:
            continue
        before, begin, rest = text.partition(first)
        _, end, after = rest.partition(last)
        if not (begin and end):
            raise SystemExit(f"{path} has no {first} and {last}: put them where the tables belong")
        blocks = [as_markdown(section, seeds=seeds_of(section, rows)) for section in mine]
        text = "\n".join([f"{before}{begin}", *blocks, f"{end}{after}"])
    path.write_text(text, encoding="utf-8")


def _rig_sections(rows: Sequence[Row]) -> list[Section]:
    found = rig_section(rows)
    return [] if found is None else [found]


def _of(rows: Iterable[Row], *names: str, method: str = "auto") -> list[Row]:
    return [row for row in rows if row.set_name in names and row.method == method]


def _accepted(rows: Iterable[Row]) -> list[Row]:
    return [row for row in rows if row.accepted]


def _wrong(rows: Iterable[Row]) -> list[Row]:
    return [row for row in _accepted(rows) if not row.error_px <= RIGHT_PX]


def _over(rows: Sequence[Row], name: str, how: Callable[[np.ndarray], float]) -> float:
    return float(how(np.array([getattr(row, name) for row in rows]))) if rows else float("nan")


def _worst(rows: Sequence[Row], name: str) -> float:
    return _over(rows, name, np.max)


def _median(rows: Sequence[Row], name: str) -> float:
    return _over(rows, name, np.median)


def _percent(part: Sequence[Row], whole: Sequence[Row]) -> float:
    return 100 * len(part) / len(whole) if whole else float("nan")


_HEADS = (
    "cases", "accepted", "of these > 2 px", "< 1 px", "median px", "worst px", "deg", "mm", "sigmas", "s", "worst s",
)  # fmt: skip


def _cells(rows: Sequence[Row]) -> tuple[str, ...]:
    taken = _accepted(rows)
    told = [row for row in taken if not np.isnan(row.sigmas)]
    return (
        str(len(rows)), str(len(taken)), str(len(_wrong(rows))), str(sum(row.error_px < 1 for row in taken)),
        number(_median(taken, "error_px")), number(_worst(taken, "error_px")), number(_median(taken, "error_deg"), 3),
        number(_median(taken, "error_mm"), 1), number(_over(told, "sigmas", lambda s: float(np.sqrt(np.mean(s**2))))),
        number(_median(rows, "seconds")), number(_worst(rows, "seconds")),
    )  # fmt: skip


def _peers_section(rows: Sequence[Row]) -> Section | None:
    there = [name for name in WITH_PEERS if _of(rows, name)]
    if not there:
        return None
    tables = []
    for name in there:
        of_methods = [(method, _of(rows, name, method=method)) for method in METHODS]
        tables.append((name, table(_HEADS, [(m, *_cells(mine)) for m, mine in of_methods if mine])))
    bars = [bar for name in there for bar in _set_bars(name, _of(rows, name))]
    note = (
        "Rooms by the simulator: a scan of 1000 x 700 cells and a photo of 768 x 512 pixels, nothing else given. "
        "Errors are of what was accepted; px: median displacement of the cells that the photo sees. A method without "
        "a verdict accepts whatever it finds. Both forms of the thesis's chain and the information distance (from the "
        "scanner's own position) run on a third of the cases. Sigmas: RMS error of the pose in its own standard "
        "deviations. s: the processor's seconds, all threads together."
    )
    return Section("sets", "Without a first guess, beside other methods", note, tuple(tables), tuple(bars),
                   {"sets": there})  # fmt: skip


def _set_bars(name: str, rows: Sequence[Row]) -> list[Bar]:
    taken = _accepted(rows)
    worst = _worst(taken, "error_px")
    accepted = Bar(f"{name}: accepted, %", _percent(taken, rows), least={"hard": 95, "wide": 80}.get(name, 100))
    if name == "standard":
        return [
            accepted,
            Bar(f"{name}: worst px", worst, most=0.6),
            Bar(f"{name}: median px", _median(taken, "error_px"), most=0.3),
            Bar(f"{name}: median deg", _median(taken, "error_deg"), most=0.06, digits=3),
            Bar(f"{name}: median mm", _median(taken, "error_mm"), most=6),
        ]
    if name == "hard":
        below = _percent([row for row in taken if row.error_px < 1], taken)
        return [accepted, Bar(f"{name}: of these < 1 px, %", below, least=95), Bar(f"{name}: worst px", worst, most=2)]
    return [accepted, Bar(f"{name}: worst px", worst, most=1 if name == "wide" else RIGHT_PX)]


def _intrinsics_section(rows: Sequence[Row]) -> Section | None:
    mine = _of(rows, "intrinsics")
    if not mine:
        return None
    taken = _accepted(mine)
    names = (("error_px", "px", 0.5), ("error_mm", "mm", 25), ("focal_percent", "% of f", 0.5), ("k1", "k1", 0.03))
    cells = [
        (unit, number(_median(taken, name), 3), number(_worst(taken, name), 3)) for name, unit, _ in names
    ]  # fmt: skip
    bars = [Bar("wrong cameras: accepted, %", _percent(taken, mine), least=100)]
    bars += [
        Bar(f"wrong cameras: worst {unit}", _worst(taken, name), most=most, digits=3) for name, unit, most in names
    ]
    note = (
        "The stated focal length is 5 % too long or too short, or the stated k1 .15 too large, or both; the camera is "
        f"estimated with the pose. Errors of the {len(taken)} that were accepted, of {len(mine)}."
    )
    of_errors = table(("median", "worst"), cells)
    return Section("intrinsics", "A camera that is stated wrongly", note, (("", of_errors),), tuple(bars),
                   {"sets": ["intrinsics"]})  # fmt: skip


def _thermal_section(rows: Sequence[Row]) -> Section | None:
    mine = _of(rows, "thermal")
    if not mine:
        return None
    right = [row for row in _accepted(mine) if row.error_px <= RIGHT_PX]
    bar = Bar("thermal: accepted within 2 thermal px, %", _percent(right, mine), least=80)
    note = "Pictures of 320 x 240 temperatures; px are those of the thermal picture."
    of_cells = table(_HEADS, [("auto", *_cells(mine))])
    return Section("thermal", "Thermal pictures", note, (("", of_cells),), (bar,), {"sets": ["thermal"]})


_ASKED = {
    "wrong": "photograph of another room",
    "near": "started 4, 8 and 16 degrees and up to .8 m off, no other help",
    "blank": "one gray level, noise",
    "thermal wrong": "thermal picture of another room",
}


def _refusals_section(rows: Sequence[Row]) -> Section | None:
    there = [name for name in _NO_RIGHT_ANSWER if _of(rows, name)]
    if not there:
        return None
    cells = []
    for name in there:
        mine = _of(rows, name)
        cells.append((
            _ASKED[name], str(len(mine)), str(len(_accepted(mine))), str(len(_wrong(mine))),
            number(_median(mine, "seconds")), number(_worst(mine, "seconds")),
        ))  # fmt: skip
    bars = [
        Bar(f"{_ASKED[name]}: accepted and > 2 px off", len(_wrong(_of(rows, name))), most=0, digits=0)
        for name in there
    ]
    note = "What must not be accepted, unless it is right: a climb from a wrong start may come home."
    heads = ("cases", "accepted", "of these > 2 px", "s", "worst s")
    return Section("refusals", "What is not to be accepted", note, (("", table(heads, cells)),), tuple(bars),
                   {"sets": there})  # fmt: skip


def _real_section(rows: Sequence[Row]) -> Section | None:
    mine = _of(rows, "real")
    if not mine:
        return None
    cells = [
        (row.what, "yes" if row.accepted else "no", number(row.error_px), number(row.error_deg),
         number(row.error_mm, 1), number(row.seconds))
        for row in mine
    ]  # fmt: skip
    bar = Bar("real captures: accepted and > 2 px off", len(_wrong(mine)), most=0, digits=0)
    note = "Sensors' own scans and photographs, against the makers' calibration. Not part of the project."
    of_cells = table(("accepted", "px", "deg", "mm", "s"), cells)
    return Section("real", "Real captures", note, (("", of_cells),), (bar,), {"sets": ["real"]})


def _times_section(rows: Sequence[Row]) -> Section | None:
    found = [row for row in _of(rows, "standard", "hard", "wide") if row.accepted]
    refused = [row for row in _of(rows, "wrong") if not row.accepted]
    if not found and not refused:
        return None
    of_steps: dict[str, list[str]] = {}
    for name in dict.fromkeys(name for row in (*found, *refused) for name in row.steps):
        medians = [float(np.median([row.steps.get(name, 0.0) for row in some])) if some else 0.0
                   for some in (found, refused)]  # fmt: skip
        of_steps[name] = [number(seconds, 3) if seconds else NOTHING for seconds in medians]
    bars = []
    if found:
        bars += [Bar("accepted: median s", _median(found, "seconds"), most=1),
                 Bar("accepted: worst s", _worst(found, "seconds"), most=2.5)]  # fmt: skip
    if refused:
        bars += [Bar("refused: median s", _median(refused, "seconds"), most=3),
                 Bar("refused: worst s", _worst(refused, "seconds"), most=3)]  # fmt: skip
    note = (
        "Median seconds of the clock by step, over what was accepted of standard, hard and wide, and over what was "
        "refused of other rooms. The bars are of the processor's seconds, all threads together."
    )
    of_cells = table(("accepted", "refused"), [(name, *cells) for name, cells in of_steps.items()])
    return Section("times", "Times", note, (("", of_cells),), tuple(bars),
                   {"sets": ["standard", "hard", "wide", "wrong"]})  # fmt: skip
