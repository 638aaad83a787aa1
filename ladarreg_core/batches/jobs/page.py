"""The page of a batch, `index.html`: one self-contained file, also while the batch runs; failures come first."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from ladarreg_core.batches.jobs.run_folder import JOBS_RUN
from ladarreg_core.batches.photos.summary_page import sigma_words, summary_row, whole_page
from ladarreg_core.export.report.style import BATCH_STYLE
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.foundations.markup import Content, Html, definitions, section, tag
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.storage.checksums import sealed_page

_MAX_REASONS = 3
_MAX_PICTURES = 2000  # of the rows that come first: the page would become too large for a browser
_RANKS = ("failed", "refused", "coarse", "accepted")
_BADGES = {
    "failed": ("bad", "failed"), "refused": ("bad", "refused"), "coarse": ("warn", "accepted, coarse"),
    "accepted": ("ok", "accepted"),
}  # fmt: skip
_KINDS = {"pair": "", "photos": "photos of a scan", "survey": "survey"}
_SCRIPT = """
"use strict";
(() => {
  const body = document.querySelector(".photos tbody"), tools = document.querySelector(".tools");
  if (!body) return;
  const rows = [...body.rows], buttons = [...tools.querySelectorAll("button")];
  const order = tools.querySelector("select"), words = tools.querySelector("input");
  const count = document.getElementById("shown");
  const known = new URLSearchParams(location.hash.slice(1));
  let shown = known.get("show") || "all";
  order.value = known.get("sort") || "verdict";
  if (order.selectedIndex < 0) order.value = "verdict";
  words.value = known.get("find") || "";
  const number = (row, name) => row.dataset[name] === undefined ? Infinity : Number(row.dataset[name]);
  const by = {
    verdict: (a, b) => number(a, "rank") - number(b, "rank") || number(a, "place") - number(b, "place"),
    list: (a, b) => number(a, "place") - number(b, "place"),
    name: (a, b) => a.dataset.name.localeCompare(b.dataset.name, undefined, { numeric: true }),
    sigma: (a, b) => (number(b, "sigma") === Infinity ? -1 : number(b, "sigma")) -
      (number(a, "sigma") === Infinity ? -1 : number(a, "sigma")),
  };
  function show() {
    const wanted = words.value.trim().toLowerCase();
    let seen = 0;
    for (const row of rows) {
      row.hidden = (shown !== "all" && row.dataset.state !== shown) ||
        (wanted !== "" && !row.textContent.toLowerCase().includes(wanted));
      seen += row.hidden ? 0 : 1;
    }
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.value === shown));
    count.textContent = `${seen} of ${rows.length} shown`;
    const state = new URLSearchParams();
    if (shown !== "all") state.set("show", shown);
    if (order.value !== "verdict") state.set("sort", order.value);
    if (words.value) state.set("find", words.value);
    history.replaceState(null, "", `#${state}`);
  }
  function sort() { rows.sort(by[order.value]); body.append(...rows); show(); }
  for (const button of buttons) button.addEventListener("click", () => { shown = button.value; show(); });
  order.addEventListener("change", sort);
  words.addEventListener("input", show);
  tools.hidden = false;
  sort();
})();
"""
_RELOAD = """
setTimeout(() => { if (document.activeElement?.tagName !== "INPUT") location.reload(); }, 10000);
"""


def write_batch_page(
    path: Path, document: Mapping[str, Any], found: Mapping[str, Mapping[str, Any]], *, running: bool
) -> None:
    """Write the page with its checksum, see `sealed_page`; the arguments are those of `batch_page`.

    Raises:
        ExportError: if it cannot be written.
    """
    write_bytes(path, sealed_page(batch_page(document, found, running=running).encode("utf-8")))


def batch_page(document: Mapping[str, Any], found: Mapping[str, Mapping[str, Any]], *, running: bool) -> str:
    """Return the page as HTML; it can be read without its script, which sorts and filters.

    Args:
        document: the contents of `batch.json`, so far.
        found: what is known of each job that was done, by its id, with its `thumbnail`.
        running: whether jobs are still being done: the page then loads itself anew every ten seconds.
    """
    jobs, outcomes = document["jobs"], document["outcomes"]
    done = sum(outcomes.values())
    waiting = len(jobs) - done
    title = f"{len(jobs)} jobs" if len(jobs) != 1 else "1 job"
    kind = "warn" if waiting else "ok" if outcomes["accepted"] == done else "bad"
    words = f"{done} of {len(jobs)} done" if running else f"{outcomes['accepted']} of {len(jobs)} accepted"
    places = {name: place for place, name in enumerate(jobs)}
    listed = sorted(
        ((name, one) for name, one in jobs.items() if one["outcome"] is not None),
        key=lambda item: _RANKS.index(_state(item[1])),
    )
    rows = [
        _row(name, one, found[name] if row < _MAX_PICTURES else {}, places[name])
        for row, (name, one) in enumerate(listed)
    ]
    table = tag("table", tag("tbody", rows), class_="photos") if rows else tag("p", "No job is done yet.")
    body = [
        tag("header", tag("h1", title), tag("p", tag("span", words, class_=f"badge {kind}"))),
        _figures(document, waiting),
        section("jobs", "Jobs", _tools(listed), table),
        section("software", "Software", definitions([(k, str(v)) for k, v in document["software"].items()])),
    ]
    return whole_page(title, body, style=BATCH_STYLE, script=_SCRIPT + (_RELOAD if running else ""))


def _state(job: Mapping[str, Any]) -> str:
    return "coarse" if job["outcome"] == "accepted" and job["precision"] == "coarse" else str(job["outcome"])


def _figures(document: Mapping[str, Any], waiting: int) -> Html:
    """Return the figures over all jobs."""
    sigmas = [
        one["sigma"] for one in document["jobs"].values()
        if one["outcome"] == "accepted" and one.get("sigma") is not None
        and all(one["sigma"].get(name) is not None for name in ("position_m", "angle_rad"))
    ]  # fmt: skip
    boxes = [(str(document["outcomes"][name]), name) for name in ("accepted", "refused", "failed")]
    boxes += [(str(waiting), "to be done")] if waiting else []
    if sigmas:
        boxes += [
            (format_length(median(one["position_m"] for one in sigmas)), "median sigma of the position"),
            (format_angle(median(one["angle_rad"] for one in sigmas)), "median sigma of the direction"),
        ]
    return tag("div", [tag("div", tag("b", value), tag("span", what, class_="dim")) for value, what in boxes],
               class_="figures")  # fmt: skip


def _tools(listed: list[tuple[str, Mapping[str, Any]]]) -> Html:
    """Return the buttons that filter and the order, hidden where there is no script."""
    counts = {state: sum(_state(one) == state for _, one in listed) for state in _RANKS}
    buttons = [tag("button", "All", type="button", value="all", aria_pressed="true")]
    buttons += [
        tag("button", f"{_BADGES[state][1].capitalize()} {count}", type="button", value=state, aria_pressed="false")
        for state, count in counts.items() if count
    ]  # fmt: skip
    orders = (("verdict", "failures first"), ("list", "as in the list"), ("name", "by name"),
              ("sigma", "by sigma, largest first"))  # fmt: skip
    order = tag("select", [tag("option", words, value=value) for value, words in orders], aria_label="Order")
    search = tag("input", type="search", placeholder="Name or reason", aria_label="Find")
    return tag("div", *buttons, order, search, tag("span", id="shown", class_="dim"), class_="tools", hidden="")


def _row(name: str, job: Mapping[str, Any], found: Mapping[str, Any], place: int) -> Html:
    state = _state(job)
    files = ", ".join(job["files"][:3]) + (f" and {len(job['files']) - 3} more" if len(job["files"]) > 3 else "")
    text: list[Content] = [tag("p", files, class_="dim")]
    if job["outcome"] != "failed":
        text.append(tag("p", str(job["verdict"])))
    if job["sigma"] is not None and job["outcome"] == "accepted":
        text.append(tag("p", sigma_words(job["sigma"])))
    text.append(tag("ul", [tag("li", reason) for reason in job["reasons"][-_MAX_REASONS:]]))
    return summary_row(
        name, _BADGES[state], text, thumbnail=str(found.get("thumbnail") or ""),
        link=f"{JOBS_RUN.results}/{name}/{job['report']}" if job["folder"] else None, note=_KINDS[job["kind"]],
        data_state=state, data_rank=_RANKS.index(state), data_place=place, data_name=name,
        data_sigma=(job["sigma"] or {}).get("position_m"),
    )  # fmt: skip
