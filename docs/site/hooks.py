"""Keeps the built pages free of addresses elsewhere: what the theme would load from a server is here or left out."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_WORKER_ELSEWHERE = re.compile(r'<script src="https://unpkg\.com/iframe-worker/shim"></script>')
_ELSEWHERE = re.compile(r"https://(?:unpkg\.com|api\.github\.com|gitlab\.com/api)[^\"'`]*")


def on_post_page(output: str, *, page: Any, config: Any) -> str:
    """Replace the script that lets pages search that are opened as files."""
    del config
    above = "../" * page.url.count("/")
    return _WORKER_ELSEWHERE.sub(f'<script src="{above}site/file_worker.js"></script>', output)


def on_post_template(output_content: str, **_: Any) -> str:
    """Do the same for the page that is shown where there is none."""
    return _WORKER_ELSEWHERE.sub('<script src="/site/file_worker.js"></script>', output_content)


def on_post_build(*, config: Any) -> None:
    """Remove the addresses of what the theme loads for features that these pages do not use."""
    for path in Path(config["site_dir"], "assets", "javascripts").rglob("*.js"):
        text = path.read_text(encoding="utf-8")
        path.write_text(_ELSEWHERE.sub("", text), encoding="utf-8")
