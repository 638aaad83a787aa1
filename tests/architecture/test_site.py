"""The documents are built strictly, contain everything public, and load nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import ladarreg_core

if TYPE_CHECKING:
    from playwright.sync_api import Browser

CHECKOUT = Path(__file__).resolve().parents[2]
_LOADED = re.compile(
    r"""(?:src|href|srcset|action)\s*=\s*["']?\s*((?:https?:)?//[^"'\s>]+)|url\(\s*["']?((?:https?:)?//[^"')]+)"""
)
_ADDRESS = re.compile(r"https?://[\w.-]+")
_NAMED_ONLY = {  # name spaces, and examples in the text
    "http://www.w3.org", "http://www.sitemaps.org", "http://127.0.0.1", "http://192.168.1.64", "http://unix",
    "https://scans.example.org",
}  # fmt: skip

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocstrings", reason="mkdocs is not installed")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder / "site")],
        cwd=CHECKOUT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr, built.stderr
    return folder / "site"


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    pages = [*site.rglob("*.html"), *site.rglob("*.css"), *site.rglob("*.svg")]
    assert len(pages) > 20
    found = {match for page in pages for match in _LOADED.findall(page.read_text(encoding="utf-8"))}
    assert not found
    text = "".join(page.read_text(encoding="utf-8") for page in site.rglob("*.html"))
    assert not {*_ADDRESS.findall(text)} - _NAMED_ONLY
    assert _LOADED.search('<script src="https://unpkg.com/x">'), "the control"


def test_the_theme_asks_no_server(site: Path) -> None:
    scripts = "".join(path.read_text(encoding="utf-8") for path in site.rglob("*.js"))
    assert not re.findall(r"https://(?:unpkg|api\.github|cdn|fonts|gitlab)[\w./-]*", scripts)


def test_everything_public_has_its_place(site: Path) -> None:
    page = (site / "api.html").read_text(encoding="utf-8")
    headings = set(re.findall(r'id="ladarreg_core\.(?:[\w.]+\.)?(\w+)"', page))
    assert {*ladarreg_core.__all__} <= headings, {*ladarreg_core.__all__} - headings


def test_a_page_opened_as_a_file_can_be_searched(site: Path, browser: Browser) -> None:
    page = browser.new_page()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto((site / "thesis-results.html").as_uri())
    page.locator(".md-search__input").click()
    page.locator(".md-search__input").press_sequentially("covariance")
    page.locator(".md-search-result__link").first.wait_for(timeout=20_000)
    assert all(url.startswith("file:") or url.startswith("data:") for url in asked), asked
    page.close()
