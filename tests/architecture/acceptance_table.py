"""The tables of acceptance thresholds in docs/quality.md, from the options' fields and their docstrings.

`python -m tests.architecture.acceptance_table` writes them into the page.
"""

from __future__ import annotations

import ast
import inspect
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np

from ladarreg_core.matching.verify.verification import COARSE_GATE, GateOptions
from ladarreg_core.pose.acceptance import AcceptanceOptions

PAGE = Path(__file__).parents[2] / "docs" / "quality.md"
START, END = "<!-- thresholds: written by tests/architecture/acceptance_table.py -->", "<!-- end of thresholds -->"


def field_docstrings(options: type) -> dict[str, str]:
    """Return the docstring under each field of a dataclass, in order."""
    (body,) = (
        node.body for node in ast.parse(dedent(inspect.getsource(options))).body if isinstance(node, ast.ClassDef)
    )
    found = {}
    for field, below in pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
            assert isinstance(below.value, ast.Constant)
            found[field.target.id] = " ".join(str(below.value.value).split())
    return found


def tables() -> str:
    """Return the tables in Markdown."""
    usual, meanings = AcceptanceOptions(), field_docstrings(AcceptanceOptions)
    lines = ["### Match statistics: `PoseOptions.acceptance`", "", "| option | default | meaning |", "|---|---|---|"]
    lines += [f"| `{f.name}` | {_shown(f.name, getattr(usual, f.name))} | {meanings[f.name]} |" for f in fields(usual)]
    gate, meanings = GateOptions(), field_docstrings(GateOptions)
    lines += ["", "### Image verification: `AutoOptions.gate`, `ThesisOptions.gate`", ""]
    lines += ["| option | default | thermal images | meaning |", "|---|---|---|---|"]
    for f in fields(gate):
        color, thermal = (_shown(f.name, getattr(options, f.name)) for options in (gate, COARSE_GATE))
        lines.append(f"| `{f.name}` | {color} | {thermal if thermal != color else ''} | {meanings[f.name]} |")
    return "\n".join(lines)


def page_with_tables(page: str) -> str:
    """Return the page with the tables between the markers replaced."""
    before, _, rest = page.partition(START)
    _, end, after = rest.partition(END)
    if not end:
        raise ValueError(f"{PAGE} has no {START} ... {END}")
    return f"{before}{START}\n\n{tables()}\n\n{END}{after}"


def _shown(name: str, value: Any) -> str:
    return f"{value:.4g} ({np.rad2deg(value):.3g}°)" if name.endswith("_rad") else f"{value:g}"


if __name__ == "__main__":
    PAGE.write_text(page_with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
