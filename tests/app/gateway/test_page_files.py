"""The page as a browser loads it: compressed, versioned by content, and with its first pictures requested at once."""

from __future__ import annotations

import gzip
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from ladarreg.gateway.page.files import PageFiles
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import Response

from testing.workbench.gateway_driver import Running, running

PACKED = {"Accept-Encoding": "gzip, br"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("room")) as found:
        yield found


def linked(text: str, tag: str) -> list[str]:
    return re.findall(rf'<{tag}[^>]* (?:href|src)="([^"]+)"', text)


@pytest.fixture(scope="module")
def front(run: Running) -> str:
    return run.ask("GET", "/")[2].decode()


def test_every_script_and_style_of_the_page_is_versioned_and_kept_for_ever(run: Running, front: str) -> None:
    scripts, styles = linked(front, "script"), linked(front, 'link rel="stylesheet"')
    assert scripts
    assert styles
    for path in scripts + styles:
        assert re.match(r"v/[0-9a-f]{16}/", path), path
        status, headers, body = run.ask("GET", f"/{path}", PACKED)
        assert status == 200
        assert "immutable" in headers["cache-control"]
        assert headers["cache-control"].startswith("private")
        assert headers["content-encoding"] == "gzip"
        assert headers["vary"] == "accept-encoding"
        plain = run.ask("GET", f"/{path}")
        assert "content-encoding" not in plain[1]
        assert gzip.decompress(body) == plain[2]


def test_the_page_itself_is_compressed_and_revalidated(run: Running, front: str) -> None:
    _, headers, body = run.ask("GET", "/", PACKED)
    assert gzip.decompress(body).decode() == front
    assert headers["content-encoding"] == "gzip"
    assert headers["cache-control"] == "no-cache"
    assert headers["content-type"] == "text/html; charset=utf-8"
    assert run.ask("GET", "/", PACKED | {"If-None-Match": headers["etag"]})[0] == 304


def test_every_module_and_every_style_is_in_a_bundle(run: Running, front: str, checkout: Path) -> None:
    static = checkout / "static"
    classic = {path.split("/", 2)[2] for path in re.findall(r'<script src="([^"]+)"', front)}
    texts = []
    for path in linked(front, 'script type="module"'):
        _, headers, body = run.ask("GET", f"/{path}")
        assert headers["content-type"].startswith("text/javascript")
        texts.append(body.decode())
        _, headers, told = run.ask("GET", f"/{path}.map")
        assert headers["content-type"] == "application/json"
        assert json.loads(told)["version"] == 3
    kept = [path for text in texts for path in re.findall(r'^\$modules\["([^"]+)"\] = ', text, re.M)]
    modules = {path.relative_to(static).as_posix() for path in (static / "js").rglob("*.js")}
    assert sorted(kept) == sorted(modules - classic), "each once"
    assert len(texts) == 2
    (sheet,) = linked(front, 'link rel="stylesheet"')
    _, headers, body = run.ask("GET", f"/{sheet}")
    assert headers["content-type"].startswith("text/css")
    # viser.css is that of the 3-D view; the order is that of the page
    named = re.findall(r'stylesheet" href="([^"]+)"', (static / "index.html").read_text())
    assert set(named) == {path.relative_to(static).as_posix() for path in static.rglob("*.css")} - {"viser.css"}
    assert body == b"".join((static / path).read_bytes() for path in named)


def test_the_first_pictures_come_before_all_scripts(front: str) -> None:
    pictures = linked(front, 'link rel="preload" as="image" fetchpriority="high"')
    assert pictures == linked(front, "img") == ["picture/scan?rev=1&amp;form=quick"]
    assert front.index(pictures[0]) < front.index("<script")
    assert "<!--" not in front, "everything is filled in"


def test_the_version_in_a_path_must_exist_as_a_file(run: Running, front: str) -> None:
    version = linked(front, "script")[0].split("/")[1]
    for path in ("js/none.js", "../index.html", "index.html", "js/.hidden.js", ""):
        assert run.ask("GET", f"/v/{version}/{path}")[0] == 404


def test_a_script_by_its_plain_name_is_the_pages_own(run: Running, front: str) -> None:
    version = linked(front, "script")[0].split("/")[1]
    status, headers, body = run.ask("GET", "/js/net/store.js")
    assert status == 200
    first, second = body.decode().splitlines()
    assert first == f'import {{ $modules }} from "../../v/{version}/bundle/js/early.js";'
    assert re.fullmatch(r'export const \{ .*\bstore\b.* \} = \$modules\["js/net/store.js"\];', second)
    assert headers["cache-control"] == "no-cache"
    assert run.ask("GET", "/js/none.js")[0] == 404


def test_an_edited_script_arrives_with_the_next_reload(tmp_path: Path, checkout: Path) -> None:
    folder = tmp_path / "static"
    shutil.copytree(checkout / "static", folder)
    files = PageFiles(folder)

    def fetched(path: str) -> Response:
        _, version, rest = path.split("/", 2)
        parameters = {"version": version, "path": rest}
        return files.versioned(Request({"type": "http", "headers": [], "path_params": parameters}))

    def main_script() -> str:
        page = files.front_page({}, Headers()).body
        return linked(bytes(page).decode(), 'script type="module"')[-1]

    before = main_script()
    assert main_script() == before
    with (folder / "js/main.js").open("a") as file:
        file.write("\n// edited\n")
    after = main_script()
    assert after != before
    new = fetched(after)
    assert "immutable" in new.headers["cache-control"]
    assert b"\n// edited\n" in bytes(new.body)
    old = fetched(before)
    assert old.status_code == 200, "a page that is being loaded still gets its scripts"
    assert old.body == new.body
    assert old.headers["cache-control"] == "no-cache"
