"""Bundles: the modules in few files, word for word but for imports, exports and comments, in the same order."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from ladarreg.gateway.page.bundles import bundled, re_exported

_FOLDER = "bundle"
_TOKENS = r"""
import fs from "fs";
import { createRequire } from "module";
const [checkout, bundles] = process.argv.slice(2);
const acorn = createRequire(checkout + "/")("acorn");
const options = { ecmaVersion: "latest", sourceType: "module" };
const tokens = (text) =>
  [...acorn.tokenizer(text, options)].map(({ type, value }) => `${type.label} ${value?.pattern ?? value}`).join("\n");
const ownBody = (text) => acorn.parse(text, options).body
  .filter(({ type }) => type !== "ImportDeclaration")
  .map((node) => text.slice(node.type === "ExportNamedDeclaration" ? node.declaration.start : node.start, node.end));
const differing = [];
const compared = [];
for (const text of JSON.parse(fs.readFileSync(bundles, "utf8"))) {
  for (const { expression } of acorn.parse(text, options).body) {
    if (expression?.type !== "AssignmentExpression") continue;
    const path = expression.left.property.value;
    const words = expression.right.callee.body.body
      .filter(({ type }) => type !== "ReturnStatement")
      .map((one) => text.slice(one.start, one.end))
      .filter((one) => !/^const .* = \$modules\[/.test(one));
    const module = fs.readFileSync(`${checkout}/static/${path}`, "utf8");
    compared.push(path);
    if (tokens(words.join("\n")) !== tokens(ownBody(module).join("\n"))) differing.push(path);
  }
}
console.log(JSON.stringify({ compared, differing }));
"""
_DIGITS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
SMALL = {
    "js/store.js": """/** A store. */

export const told = [];

/** Tells.
 * @param {string} word
 */
export const tell = (word) => told.push(word);
""",
    "js/ui/word.js": """import { tell as say } from "../store.js";

say("word");
export class Word {
  /** Its letters. */
  letters = `a

/* b */`;
}
export async function later() {}
""",
    "js/early.js": 'import { tell } from "./store.js";\n\ntell("early");\n',
    "js/main.js": """import {
  told,
  tell,
} from "./store.js";
import * as words from "./ui/word.js";

tell("main");
console.log(JSON.stringify([told, Object.keys(words), new words.Word().letters]));
""",
}


def node(*words: str) -> str:
    """Run Node and return what it prints."""
    if shutil.which("node") is None:
        pytest.skip("there is no Node")
    return subprocess.run(["node", *words], capture_output=True, text=True, check=True, timeout=120).stdout


def page_modules(checkout: Path) -> dict[str, str]:
    static = checkout / "static"
    return {path.relative_to(static).as_posix(): path.read_text() for path in (static / "js").rglob("*.js")}


def test_what_is_evaluated_is_the_same_in_the_same_order(tmp_path: Path) -> None:
    found = bundled(["js/early.js", "js/main.js"], SMALL, folder=_FOLDER)
    for entry, bundle in found.items():
        target = tmp_path / _FOLDER / entry
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(bundle.text)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    assert list(found["js/early.js"].exports) == ["js/store.js", "js/early.js"]
    assert "/**" not in found["js/main.js"].text
    start = 'import "./bundle/js/early.js";\nimport "./bundle/js/main.js";\n'
    store = re_exported(found["js/early.js"].exports["js/store.js"], "js/store.js", "./bundle/js/early.js")
    (tmp_path / "store.js").write_text(store)
    (tmp_path / "all.js").write_text(f'{start}import {{ told }} from "./store.js";\nconsole.log(told.join());\n')
    first, second = node(str(tmp_path / "all.js")).splitlines()
    assert json.loads(first) == [["early", "word", "main"], ["Word", "later"], "a\n\n/* b */"]
    assert second == "early,word,main", "the same objects by its plain name"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('import main from "./store.js";\n', "'import main from"),
        ("export default 3;\n", "'export default 3;'"),
        ("export let count = 3;\n", "'export let count"),
        ("const a = 1;\nexport { a };\n", "'export { a };'"),
        ('import { a } from "./nowhere.js";\n', r"js/early.js imports js/nowhere.js, which does not exist"),
        ('import { a } from "./early.js";\n', "js/early.js imports itself"),
        ("const $modules = 1;\n", "the name \\$modules"),
    ],
)
def test_what_is_written_otherwise_is_refused(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        bundled(["js/early.js"], SMALL | {"js/early.js": text}, folder=_FOLDER)


def lines_of(mappings: str) -> list[tuple[int, int] | None]:
    """Return the source and the line of each line of a map. Source: the format of source maps, revision 3."""
    source = line = 0
    found: list[tuple[int, int] | None] = []
    for segment in mappings.split(";"):
        values, shift, value = [], 0, 0
        for digit in map(_DIGITS.index, segment):
            value, shift = value + ((digit & 31) << shift), shift + 5
            if not digit & 32:
                values.append(-(value >> 1) if value & 1 else value >> 1)
                value = shift = 0
        if values:
            assert (len(values), values[0], values[3]) == (4, 0, 0)
            source, line = source + values[1], line + values[2]
        found.append((source, line) if values else None)
    return found


def test_the_map_leads_back_to_every_line(checkout: Path) -> None:
    modules = page_modules(checkout)
    for entry, bundle in bundled(["js/early.js", "js/main.js"], modules, folder=_FOLDER).items():
        told: dict[str, Any] = json.loads(bundle.source_map)
        paths = [source.removeprefix("../../") for source in told["sources"]]
        assert set(paths) == set(bundle.exports), entry
        lines = bundle.text.splitlines()
        places = lines_of(told["mappings"])
        assert len(places) == len(lines)
        mapped = [(line, place) for line, place in zip(lines, places, strict=True) if place is not None]
        assert len(mapped) > 0.9 * len(lines)
        for line, (source, number) in mapped:
            there = modules[paths[source]].split("\n")[number]
            assert line in (there, there.removeprefix("export ")) or "$modules[" in line


def test_bundles_have_the_words_of_the_modules(checkout: Path, tmp_path: Path) -> None:
    if not (checkout / "node_modules" / "acorn").exists():
        pytest.skip("acorn is not installed; run npm ci in the checkout")
    found = bundled(["js/early.js", "js/main.js"], page_modules(checkout), folder=_FOLDER)
    (tmp_path / "bundles.json").write_text(json.dumps([bundle.text for bundle in found.values()]))
    (tmp_path / "tokens.mjs").write_text(_TOKENS)
    told = json.loads(node(str(tmp_path / "tokens.mjs"), str(checkout), str(tmp_path / "bundles.json")))
    assert told["differing"] == []
    assert sorted(told["compared"]) == sorted(path for bundle in found.values() for path in bundle.exports)
