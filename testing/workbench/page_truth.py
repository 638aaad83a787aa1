"""Compares every figure and every word of a verdict on the page with the project, as it lies on the disk.

Two questions are asked. Does the workbench say of the project what the project is (`server_contradictions`)? And does
the page say what the workbench sent it, everywhere alike (`page_contradictions`)? The expected texts are written here
again, from the documented slices; nothing of the page's own code is used.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg.session.loader import Loader

from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.quality.verdict import LIGHT_WORDS, verdict_of
from testing.workbench.measured_truth import page_measurements, page_smoothing
from testing.workbench.station_truth import page_stations, server_stations
from testing.workbench.survey_truth import page_survey

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from ladarreg_core.project.document import Document

_FACTS = (Path(__file__).parent / "page_facts.js").read_text(encoding="utf-8")
_LEVELS = {"verified": "ok", "matches_only": "only", "given": "none", "not_accepted": "warn", "out_of_date": "none"}
_JUDGES = (
    "solve",
    "robust",
    "linear",
    "constrained",
    "simplex",
    "reject_outliers",
    "verify",
    "auto",
    "thesis",
    "compare",
)
_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ"}
_FIGURE = re.compile(r"\d+(?:\.\d+)?")
_OF_THE_VIEW = re.compile(
    r"^[\d.]+ %$|^×[\d.]+$|^[\d.]+–[\d.]+ %$|^saved \d\d:\d\d:\d\d$|^\d\d:\d\d(:\d\d)?$|"
    r"^(Follow )?Operator \d+$|^\d+ clients?$"
)
"""What belongs to the view, the clock or the people, and not to the document."""


def facts_of(page: Page) -> dict[str, Any]:
    """Return what the page says now."""
    return dict(page.evaluate(_FACTS))


@contextmanager
def project_on_disk(folder: Path) -> Iterator[tuple[Document, Loader]]:
    """Read a project that is open elsewhere, from a copy: every step is on the disk before it is answered."""
    with tempfile.TemporaryDirectory() as parent:
        copy = Path(parent) / "copy"
        shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("*.part", "lock", "exports"))
        project = ProjectFolder(copy)
        try:
            yield project.read().document, Loader(project)
        finally:
            project.close()


def server_contradictions(folder: Path, slices: dict[str, Any]) -> list[str]:
    """Return where the slices say something else than the project on the disk."""
    found: list[str] = []
    with project_on_disk(folder) as (document, loader):

        def same(what: str, told: Any, true: Any) -> None:
            if told != true:
                found.append(f"{what}: the workbench says {told!r}, the project is {true!r}")

        same("photographs", [each["id"] for each in slices["photos"]], [each.id for each in document.photos])
        same("scan", (slices["scan"] or {}).get("name"), document.scan.name if document.scan else None)
        for entry, told in zip(document.photos, slices["photos"], strict=False):
            name, pose = entry.id, entry.pose
            picks = [(pick["id"], pick["on"], pick["weight"]) for pick in slices[f"picks:{name}"]]
            same(f"matches of {name}", picks, [(pick.id, pick.on, pick.weight) for pick in entry.picks])
            same(f"shown stage of {name}", slices[f"poses:{name}"]["shown"], entry.shown_stage)
            stages = {each["stage"]: each for each in slices[f"poses:{name}"]["stages"]}
            same(f"stages of {name}", set(stages), {each.stage for each in entry.poses})
            done = {step["name"]: step["done"] for step in slices[f"progress:{name}"]["steps"]}
            if pose is None:
                same(f"light of {name}", told.get("light"), None)
                same(f"ticks of {name}", [step for step in ("solve", "judge", "export") if done[step]], [])
                continue
            stale = loader.stale(document, entry, pose)
            good = pose.accepted and not stale
            same(f"ticks of {name}", (done["solve"], done["judge"]), (good, good))
            for each in entry.poses:
                registration = loader.registration(each)
                true = verdict_of(
                    registration, stage=each.stage, stale=loader.stale(document, entry, each), stages=tuple(stages)
                )
                summary = stages[each.stage]["summary"]
                for field in ("light", "line", "position", "matches"):
                    same(f"{field} of {name}, {each.stage}", summary[field], getattr(true, field))
                same(f"words of {name}, {each.stage}", summary["words"], LIGHT_WORDS[true.light])
            summary = stages[pose.stage]["summary"]
            same(f"light of {name} in the list", told["light"], summary["light"])
            if pose.accepted:
                same(f"position of {name} in the list", told["position"], summary["position"])
        found += server_stations(document, slices.get("stations"))
    return found


def page_contradictions(
    facts: dict[str, Any], slices: dict[str, Any], constants: Sequence[str], *, simplex: dict[str, Any] | None = None
) -> list[str]:
    """Return where the page says something else than the slices that it was sent.

    Args:
        facts: what the page says, from `facts_of`.
        slices: of a client that sees the same photograph.
        constants: texts that say nothing of a project, as those of a page with nothing open.
        simplex: the newest event of this kind.
    """
    if simplex is not None:
        lengths, angles = simplex["parameters"][:3], simplex["parameters"][3:]
        figures = [*(f"{_fixed(each, 3)} m" for each in lengths), *(f"{_fixed(degrees(each), 2)}°" for each in angles)]
        constants = [*constants, *figures]
    found = _Comparison(facts, slices).everything(constants)
    drawn = sum(len(slices.get(name) or []) for name in ("drawn_ties", "drawn_lines"))
    found += page_survey(facts, slices.get("photos") or [], slices.get("survey"), drawn)
    found += page_smoothing(facts, slices.get("smoothing") or {})
    measurements = (slices.get(name) or [] for name in ("measurements", "measured"))
    found += page_measurements(facts, *measurements, slices.get("stations"))
    return [*found, *page_stations(facts, slices.get("stations"), slices.get("survey"))]


class _Comparison:
    def __init__(self, facts: dict[str, Any], slices: dict[str, Any]) -> None:
        self.facts, self.slices, self.found = facts, slices, list[str]()
        self.shown = slices["shown"]
        self.photo = next((each for each in slices["photos"] if each["id"] == self.shown), None)
        self.picks = slices.get(f"picks:{self.shown}") or []
        poses = slices.get(f"poses:{self.shown}") or {"stages": [], "shown": None}
        self.stages: list[dict[str, Any]] = poses["stages"]
        self.stage = next((each for each in self.stages if each["stage"] == poses["shown"]), None)
        self.progress = slices.get(f"progress:{self.shown}") or slices["progress"]

    def same(self, what: str, told: Any, true: Any) -> None:
        if told != true:
            self.found.append(f"{what}: the page says {told!r}, and it is {true!r}")

    def among(self, what: str, told: Sequence[str], true: Sequence[str]) -> None:
        """Every text is one of those that are true; one without figures and verdict may be a label."""
        self.found += [f"{what}: the page says {each!r}" for each in told if _tells(each) and each not in true]

    def everything(self, constants: Sequence[str]) -> list[str]:
        self.head()
        self.tabs()
        self.verdict()
        self.table()
        self.depth()
        self.side_by_side()
        self.steps()
        self.job()
        self.export()
        self.others(constants)
        return self.found

    def head(self) -> None:
        scan, facts = self.slices["scan"], self.facts
        size = f"{scan['columns']}×{scan['rows']}" if scan and "columns" in scan else ""
        others = f"and {len(scan['files']) - 1} more" if scan and len(scan["files"]) > 1 else ""
        self.same("scan", facts["scan"], f"{scan['name']}{others}{size}" if scan else "Open a scan")
        self.same("photographs", facts["photo"]["hidden"], not self.slices["photos"])
        for entry in facts["list"]:
            photo = next((each for each in self.slices["photos"] if each["id"] == entry["id"]), None)
            if photo is not None:
                words = ", ".join(filter(None, [_word(photo), photo.get("position") and f"± {photo['position']}"]))
                self.same(f"{photo['name']} in the list", entry["text"], [photo["name"], words])
        if self.photo is None:
            return
        word, count = _word(self.photo), len(self.slices["photos"])
        place = [f"{[each['id'] for each in self.slices['photos']].index(self.shown) + 1}/{count}"] if count > 1 else []
        self.same("the photograph's button", facts["photo"]["text"], [self.photo["name"], f", {word}", *place])
        self.same("the photograph's light", facts["photo"]["level"], _light_level(self.photo))
        stale = f" ({self.photo['stale']})" if self.photo.get("stale") else ""
        title = facts["photo"]["title"].split("\n")[0]
        self.same("the photograph's tooltip", title, f"{self.photo['name']}: {word}{stale}")
        camera = self.photo["camera"]
        self.same("camera", facts["camera"], camera["short"] if camera else "Focal length")

    def tabs(self) -> None:
        for step in self.progress["steps"]:
            tab = self.facts["tabs"][step["name"]]
            said = f"{'Done. ' if step['done'] else ''}{step['status']} {step['missing']}".strip()
            self.same(
                f"tab {step['name']}", (tab["done"], tab["ticked"], tab["said"]), (step["done"], step["done"], said)
            )
            only = step["name"] in ("solve", "judge") and bool(self.photo) and self.photo.get("light") == "matches_only"
            self.same(f"colour of the tab {step['name']}", tab["only"] and tab["ticked"], only and step["done"])

    def verdict(self) -> None:
        told = self.facts["verdict"]
        if self.stage is None:
            self.same("verdict without a pose", (told["line"], told["figures"], told["level"]), ("", [], ""))
            solving = self.slices.get(f"solving:{self.shown}") or {}
            true = [self.progress["next_action"], f"Not solved: {solving.get('sentence')}", *self.warnings()]
            true += [text for text in told["empty"] if text.startswith("Once there is a pose, its verdict")]
            self.among("verdict without a pose", told["empty"], true)
            return
        summary = self.stage["summary"]
        self.same("stage of the verdict", told["label"], self.stage["label"])
        self.same("light of the verdict", told["level"], _LEVELS[summary["light"]])
        self.same("line of the verdict", told["line"], summary["line"])
        figures = [summary[name] for name in ("position", "pixels") if summary[name]]
        self.same("figures of the verdict", told["figures"], figures)
        self.same("matches of the verdict", told["count"], summary["matches"])
        solving = self.slices.get(f"solving:{self.shown}") or {}
        next_steps = [summary["next_step"]["sentence"], (summary["other"] or {}).get("sentence", "")]
        self.among("next step", told["next"], [*next_steps, solving.get("sentence", ""), self.progress["needed"]])
        self.among("evidence", told["evidence"], self.evidence())
        if self.stage.get("uncertainty"):  # the median is one number
            (median,) = re.findall(r"Median uncertainty ([\d.]+ px)", self.stage["uncertainty"])
            self.same("median uncertainty", median, summary["pixels"])
            for place in self.stage.get("advice") or ():
                self.same("a second median in the advice", re.findall(r"median[^.]*?[\d.]+ px", place["sentence"]), [])

    def evidence(self) -> list[str]:
        stage = self.stage or {}
        found = [_sentences([stage["verdict"]]), _sentences(stage.get("reasons") or []), stage.get("note") or ""]
        for each in stage.get("parameters") or ():
            found += [_minus(each["value"]), f"± {each['sigma']}" if each["sigma"] not in ("", "unknown") else "± ?"]
        found += [f"In the world: {stage.get('in_world')}.", stage.get("uncertainty") or "", stage.get("check") or ""]
        found += [place["sentence"] for place in stage.get("advice") or ()]
        for finding in stage.get("findings") or ():
            found += [_sentences([finding["sentence"]]), finding["what_to_do"]]
        return [" ".join(text.split()) for text in found + self.warnings() if text]

    def warnings(self) -> list[str]:
        judged = self.slices.get(f"judged:{self.shown}") or {}
        return [*(judged.get("losses") or []), *(judged.get("cautions") or [])]

    def rows(self) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
        judged = (self.slices.get(f"judged:{self.shown}") or {}).get("by_pick") or {}
        for pick in self.picks:
            yield pick, judged.get(pick["id"]) or {}

    def table(self) -> None:
        facts, total = self.facts, len(self.picks)
        enabled = sum(pick["on"] for pick in self.picks)
        self.same("enabled matches", facts["counts"], f"{enabled} of {total} enabled" if total else "")
        if not total:
            self.same("table without matches", facts["nothing"], self.progress["next_action"])
        kinds = (
            ("line", "lines", lambda pick, judged: pick["kind"] == "line"),
            ("point", "points", lambda pick, judged: pick["kind"] == "point"),
            ("detected", "detected", lambda pick, judged: pick["origin"] not in ("manual", "file")),
            ("disabled", "disabled", lambda pick, judged: not pick["on"]),
            ("outlier", "outliers", lambda pick, judged: pick["on"] and judged.get("inlier") is False),
        )
        counts = [(sum(keeps(*row) for row in self.rows()), one, many) for one, many, keeps in kinds]
        chips = [f"{count} {one if count == 1 else many}" for count, one, many in counts if count not in (0, total)]
        self.same("filters", facts["chips"], chips)
        by_id = {pick["id"]: (pick, judged) for pick, judged in self.rows()}
        for row in facts["rows"]:
            if row["id"] not in by_id:
                self.found.append(f"table: match {row['number']} is shown, and there is none")
                continue
            pick, judged = by_id[row["id"]]
            what = f"match {pick['number']} in the table"
            self.same(
                what, (row["number"], row["on"], row["cells"]["kind"]), (str(pick["number"]), pick["on"], pick["kind"])
            )
            outlier = pick["on"] and judged.get("inlier") is False
            self.same(f"mark of {what}", row["outlier"], outlier)
            self.same(f"mark of {what}", row["mark"] == "outlier", outlier)
            self.same(f"disabled {what}", (row["disabled"], row["mark"] == "disabled"), (not pick["on"],) * 2)
            mm = judged.get("mm")
            true = {
                "px": _fixed(judged.get("px"), 2), "mm": _fixed(mm, 1 if mm is not None and mm < 10 else 0),
                "depth_m": _fixed(judged.get("depth_m"), 3), "influence": _short(judged.get("influence")),
            }  # fmt: skip
            for name, text in true.items():
                self.same(f"{name} of {what}", row["cells"][name], text)
            self.same(f"warned of in {what}", [name for name in row["warns"] if name != "samples"], [])
            self.same(f"weight of {what}", float(row["weight"]), round(pick["weight"], 2 if pick["weight"] < 10 else 1))

    def depth(self) -> None:
        known = [judged["depth_m"] for _, judged in self.rows() if judged.get("depth_m") is not None]
        told = self.facts["depth"]
        if not known:
            self.same("threshold without errors", told["value"], "")
            return
        above = float(told["value"])
        rows = [
            (pick["on"], abs(judged["depth_m"]) > above)
            for pick, judged in self.rows()
            if judged.get("depth_m") is not None
        ]
        count = sum(beyond for _, beyond in rows)
        unsure = any(abs(abs(each) - above) <= 0.006 * above for each in known)  # the field is rounded
        if not unsure:
            self.same("matches above the threshold", told["status"], f"{count} match{'' if count == 1 else 'es'} above")
            off, on = sum(o and beyond for o, beyond in rows), sum(not o and not beyond for o, beyond in rows)
            said = (
                f"Disable {off}"
                if off
                else f"Re-enable {on}"
                if on
                else f"{count} disabled"
                if count
                else "Disable none"
            )
            if said not in told["head"]:
                self.found.append(f"depth error: the page says {told['head']!r}, and it is {said!r}")

    def side_by_side(self) -> None:
        told = self.facts["stages"]
        heads = [
            (_LEVELS[each["summary"]["light"]], [each["label"], f", {_stage_word(each)}"], each is self.stage)
            for each in self.stages
        ]
        self.same("stages", [(head["level"], head["text"], head["shown"]) for head in told["heads"]], heads)
        if not self.stages:
            return
        named = next((each["parameters"] for each in self.stages if each.get("parameters")), [])
        true = [
            [f"{_GREEK.get(name['name'], name['name'])} {'°' if name['unit'] == 'deg' else name['unit']}",
             [_minus(each["parameters"][k]["value"]) if each.get("parameters") else "–" for each in self.stages]]
            for k, name in enumerate(named)
        ]  # fmt: skip
        for label, text in (
            (
                "matches that agree",
                lambda each: f"{each['inliers']} of {each['matches']}" if "matches" in each else "–",
            ),
            ("σ of position", lambda each: each["summary"]["position"] or "–"),
            ("residual, median px", lambda each: _fixed(each.get("median_px"), 2)),
            ("depth error, rms m", lambda each: _fixed(each.get("rms_depth_m"), 3)),
            ("focal length px", lambda each: _fixed(each.get("focal_px"), 1)),
            ("time", lambda each: _duration(each.get("seconds"))),
        ):
            true.append([label, [text(each) for each in self.stages]])
        self.same("figures of the stages", told["rows"], true)
        for each in self.stages:
            count = re.match(r"(\d+) of (\d+) match", each["summary"]["matches"])
            if count:
                self.same(
                    f"matches of {each['label']}", (each["inliers"], each["matches"]), tuple(map(int, count.groups()))
                )

    def steps(self) -> None:
        by_label = {each["label"]: each for each in self.stages}
        for row in self.facts["steps"]:
            stage = by_label.get({"Guided matching": "Constrained linear"}.get(row["label"], row["label"]))
            if row["label"] == "Verify":
                image = (self.stage or {}).get("image")
                outcome = {"verified": "done", "contradicted": "failed", "undecidable": "unclear"}.get(
                    (image or {}).get("outcome", ""), "none"
                )
                if self.stage and self.stage["evidence"] == "image" and not image:
                    outcome = "done"
                elif image and self.stage and self.stage["stale"]:
                    outcome = "stale"
                self.same("state of Verify", row["state"], outcome)
            elif stage is not None and row["state"] not in ("failed", "running"):
                state = "stale" if stage["stale"] else "done" if stage["accepted"] else "solved"
                self.same(f"state of {row['label']}", row["state"], state)
                if not stage["stale"]:
                    parts = [
                        f"{stage['inliers']} of {stage['matches']} agree" if "matches" in stage else "",
                        f"median {_fixed(stage['median_px'], 2)} px" if stage.get("median_px") is not None else "",
                        _duration(stage["seconds"]) if stage.get("seconds") else "",
                    ]
                    self.same(f"figures of {row['label']}", row["said"], ", ".join(filter(None, parts)))

    def job(self) -> None:
        job, told, stage = self.slices["job"], self.facts["job"], self.stage
        if stage and stage["stale"]:
            self.same("status bar", told, f"Out of date: {stage['stale']}")
            return
        own = not job or not job.get("photo") or job["photo"] == self.shown
        if stage is None:
            self.same(
                "status bar without a pose", bool(re.search("verified|accepted", told, re.IGNORECASE)) and own, False
            )
        elif not job or not own or (job["kind"] in _JUDGES and job["state"] == "done"):
            parts = [f"{stage['label']}: {stage['summary']['line']}", stage["summary"]["matches"]]
            self.same("status bar", told, " · ".join(filter(None, parts)))
            self.same("colour of the status bar", self.facts["job_level"], _LEVELS[stage["summary"]["light"]])
        elif job["kind"] != "check_at_stations":  # which says what the scans of other stations verify
            self.same("status bar on another job", bool(re.search("verified|accepted", told, re.IGNORECASE)), False)

    def export(self) -> None:
        told, stage = self.facts["export"], self.stage
        exported = "results" in self.progress["exported"] and not (stage or {}).get("stale")
        if stage is not None and stage["stale"] and "Left out" in told["text"]:
            self.same("export is refused", told["zip"], True)
            self.same("export", f"its pose is out of date: {stage['stale']}" in told["text"], True)
        elif "out of date" in told["text"]:
            self.same("export of a pose out of date", bool(self.slices["photos"][1:]), True)
        self.same("ticks of files", told["ticks"] > 0, stage is not None and exported)

    def others(self, constants: Sequence[str]) -> None:
        """Everything else with a figure or a word of a verdict is something that the workbench sent."""
        sent = " ".join(_texts_in(self.slices))
        for part, _, text in self.facts["rest"]:
            if text in constants or _OF_THE_VIEW.search(text) or text in sent or _typed(text) in sent:
                continue
            known = [
                figure
                for figure in _FIGURE.findall(text)
                if not re.search(rf"(?<![\d.]){re.escape(figure)}(?![\d])", sent)
            ]
            if not known and not re.search(r"accepted|verified|out of date|contradict|refused", text, re.IGNORECASE):
                continue
            self.found.append(f"{part}: the page says {text!r}, which the workbench did not send")


def _tells(text: str) -> bool:
    return bool(re.search(r"\d|verified|accepted|out of date|contradict", text, re.IGNORECASE))


def _texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for each in value.values():
            yield from _texts_in(each)
    elif isinstance(value, list):
        for each in value:
            yield from _texts_in(each)
    elif isinstance(value, bool) or value is None:
        return
    else:
        yield str(value)


def _typed(text: str) -> str:
    return text.replace("−", "-").replace("χ²", "chi^2")


def _word(photo: dict[str, Any]) -> str:
    if photo.get("error"):
        return str(photo["error"])
    return str(photo.get("light_words", "not solved yet")) if photo["camera"] else "focal length unknown"


def _light_level(photo: dict[str, Any]) -> str:
    if photo.get("error"):
        return "bad"
    return _LEVELS.get(photo.get("light", ""), "none") if photo["camera"] else "warn"


def _stage_word(stage: dict[str, Any]) -> str:
    return f"out of date: {stage['stale']}" if stage["stale"] else str(stage["summary"]["words"])


def _minus(text: str) -> str:
    return re.sub(r"^-", "−", text)


def _sentences(texts: Sequence[str]) -> str:
    found = [text.strip().replace("chi^2", "χ²") for text in texts if text.strip()]
    return " ".join(f"{text[0].upper()}{text[1:]}{'' if text[-1] in '.!?' else '.'}" for text in found)


def _fixed(value: float | None, decimals: int) -> str:
    """Return a number as JavaScript's `toFixed` writes it, with a minus sign and no negative zero."""
    if value is None:
        return "–"
    from decimal import ROUND_HALF_UP, Decimal

    text = str(Decimal(abs(value)).quantize(Decimal(1).scaleb(-decimals), ROUND_HALF_UP))
    return f"−{text}" if value < 0 and float(text) else text


def _short(value: float | None) -> str:
    if value is None:
        return "–"
    size = abs(value)
    return _fixed(value, 0 if size >= 100 else 1 if size >= 10 else 2 if size >= 1 else 3 if size >= 0.1 else 4)


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "–"
    if seconds < 10:
        return f"{_fixed(seconds, 2 if seconds < 1 else 1)} s"
    if seconds < 60:
        return f"{_fixed(seconds, 0)} s"
    return f"{int(seconds // 60)} min {_fixed(seconds % 60, 0).zfill(2)} s"
