"""Progress below a notebook's cell."""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

from ladarreg_core.foundations.markup import Html, tag
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.results.steps import Step

_EVERY_S = 0.1


class NotebookProgress:
    """A `report` for notebooks: `register(scan, photo, report=NotebookProgress())` shows each step as it ends.

    Readers and exports report `Progress`, which is shown as a bar; registrations report `Step`s, of which a list grows.
    Where there is no IPython, nothing is shown.
    """

    def __init__(self) -> None:
        self._steps: list[Html] = []
        self._handle: Any = None
        self._shown_s = float("-inf")
        try:
            self._display: Any = import_module("IPython.display")
        except ImportError:
            self._display = None

    def __call__(self, news: Progress | Step) -> None:
        """Show what is reported."""
        now = time.monotonic()
        if isinstance(news, Step):
            counts = "" if news.matches is None else f", {len(news.matches)} matches"
            self._steps.append(tag("li", f"{news.name}: {news.seconds:.2f} s{counts}"))
            self._show(tag("ol", self._steps, style="margin:4px 0"))
        elif now - self._shown_s >= _EVERY_S or news.done >= news.total:
            self._shown_s = now
            whole = {"max": float(news.total), "value": float(news.done)} if news.total else {}
            self._show(tag("div", tag("progress", **whole), f" {news.label}"))

    def _show(self, content: Html) -> None:
        if self._display is None:
            return
        html = self._display.HTML(str(content))
        if self._handle is None:
            self._handle = self._display.display(html, display_id=True)
        else:
            self._handle.update(html)
