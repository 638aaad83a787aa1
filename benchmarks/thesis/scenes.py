"""Tables 3.2 to 3.5: simulated scenes by every stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.register import errors as scene_errors
from benchmarks.shared import plots
from benchmarks.shared.plots import ACCENT, DIM, PINK, VIOLET, YELLOW, Bar, columns, field_width
from benchmarks.thesis import printed as printed
from benchmarks.thesis.apple import PARAMETERS, markdown, simplex_options, six
from benchmarks.thesis.descents import Convergence, convergence
from ladarreg_core.export.comparison.table import NOTHING, comparison_table, title_of
from ladarreg_core.registration.comparison import Column, Comparison, compare
from ladarreg_core.simulate import SimulatedCase, simulate_case


@dataclass(frozen=True)
class SceneRun:
    """One simulated scene by all stages."""

    case: SimulatedCase
    comparison: Comparison

    def errors(self, column: Column) -> tuple[float, float, float]:
        """Return the error against the truth: median px, deg, mm; NaN without a pose."""
        result = column.stage.result
        return (np.nan,) * 3 if result is None else scene_errors(self.case, result.camera_from_scanner)


def scene_run(scene: str, seed: int) -> SceneRun:
    case = simulate_case(scene, seed=seed)
    print(f"{scene} {seed}: simulated")
    return SceneRun(case, compare(case.scan, case.photo))


def scene_text(run: SceneRun, scene: str) -> str:
    """Return the thesis's table of a scene, with the truth and the errors against it."""
    table = comparison_table(run.comparison, run.case.scan)
    truth = dict(zip(PARAMETERS, six(run.case.camera_from_scanner), strict=True))
    rows = []
    for name, *cells in table.rows:
        if name.split(",")[0] in (*PARAMETERS, "points", "verdict"):
            known = truth.get(name.split(",")[0])
            rows.append([name, "" if known is None else f"{known:.4f}", *cells])
    off = [run.errors(column) for column in run.comparison.columns]
    for k, (name, digits) in enumerate((("error, px (median)", 2), ("error, deg", 3), ("error, mm", 1))):
        cells = [f"{e[k]:.{digits}f}" if np.isfinite(e[k]) else NOTHING for e in off]
        rows.insert(len(rows) - 1, [name, "", *cells])
    rows.append(["points in the thesis's own scene", "", *map(str, printed.SCENES[scene].points), NOTHING])
    return markdown(("truth", *table.heads), rows)


def scenes_text(runs: dict[str, list[SceneRun]]) -> str:
    """Return the errors over all seeds: median and worst, px."""
    rows = []
    for scene, mine in runs.items():
        cells = []
        for k in range(len(mine[0].comparison.columns)):
            px = [run.errors(run.comparison.columns[k])[0] for run in mine]
            known = [v for v in px if np.isfinite(v)]
            missing = f", {len(px) - len(known)} without a pose" if len(known) < len(px) else ""
            cells.append(f"{np.median(known):.2f} / {max(known):.2f}{missing}" if known else "no pose")
        rows.append([scene, *cells])
    heads = [title_of(column) for column in next(iter(runs.values()))[0].comparison.columns]
    return markdown(heads, rows)


_STAGE_COLORS = (DIM, PINK, YELLOW, VIOLET, ACCENT)
STAGE_NAMES = ("unconstrained", "constrained", "simplex", "outliers removed", "default")


def scenes_picture(runs: dict[str, list[SceneRun]]) -> np.ndarray:
    everything = [r.errors(c)[0] for mine in runs.values() for r in mine for c in r.comparison.columns]
    known = [v for v in everything if np.isfinite(v)]
    x = (10 ** np.floor(np.log10(min(known))), 10 ** np.ceil(np.log10(max(known))))
    blocks = []
    for scene, mine in runs.items():
        bars = []
        for k, (name, color) in enumerate(zip(STAGE_NAMES, _STAGE_COLORS, strict=True)):
            px = [run.errors(run.comparison.columns[k])[0] for run in mine]
            finite = [v for v in px if np.isfinite(v)]
            middle, worst = (float(np.median(finite)), max(finite)) if finite else (np.nan, np.nan)
            bars.append(Bar(name, middle, worst, color))
        blocks.append(
            plots.strips(
                f"Table {printed.SCENES[scene].table}: {scene}", bars, x=x, marks=[(1.0, plots.FAINT, "one pixel")],
                width=field_width(2, left=168), left=168, label="median displacement from the truth, px",
            )
        )  # fmt: skip
    count = len(next(iter(runs.values())))
    note = f"Median (dot) and worst (end of the line) over {count} simulated cases of each scene, against the truth."
    return plots.page("Tables 3.2 to 3.5: stage by stage", note, [columns(blocks[:2]), columns(blocks[2:])])


def simplex_of_scene(run: SceneRun) -> Convergence | None:
    """Repeat the simplex stage from the constrained pose over the same matches, and return its iterations."""
    by_name = {column.stage.name: column.stage.result for column in run.comparison.columns}
    start, simplex = by_name["constrained_linear"], by_name["simplex"]
    if start is None or simplex is None:
        return None
    return convergence(
        simplex.matches,
        run.case.photo.camera,
        simplex_options("stereo", None),
        start.camera_from_scanner,
        simplex.sigma_px,
    )


def printed_text() -> str:
    rows = []
    for scene, table in printed.SCENES.items():
        for name, points, values in zip(STAGE_NAMES, table.points, table.stages, strict=False):
            rows.append([f"{scene} (Table {table.table}), {name}", *(f"{v:.4f}" for v in values), str(points)])
    heads = [name + (", m" if k < 3 else ", deg") for k, name in enumerate(PARAMETERS)]
    return markdown([*heads, "points"], rows)
