/** What the page says, by part: every text with a figure or a word of a verdict (choices say nothing), and the parts that state facts. */
() => {
  const clean = (text) => text.replace(/\s+/g, " ").trim();
  const one = (selector, root = document) => root?.querySelector(selector) ?? null;
  const all = (selector, root = document) => [...(root?.querySelectorAll(selector) ?? [])];
  /** A panel of another step is hidden, too, and yet has to be right when it is shown. */
  const isHidden = (element) => {
    const hider = element.closest("[hidden]");
    return Boolean(hider && !hider.matches(".dock-part, .dock-page, #dock > *"));
  };
  const text = (selector, root = document) => {
    const found = typeof selector === "string" ? one(selector, root) : selector;
    return found && !isHidden(found) ? clean(found.textContent) : "";
  };
  const leaves = (root) => {
    if (!root) return [];
    const walker = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
    const found = [];
    while (walker.nextNode()) {
      const said = clean(walker.currentNode.textContent);
      if (said && !isHidden(walker.currentNode.parentElement)) found.push(said);
    }
    return found;
  };
  const level = (element) => ["ok", "only", "warn", "bad", "none", "dim", "accent"].find((each) => element?.classList.contains(each)) ?? "";
  const verdict = one("section[aria-label=Verdict]");
  const stages = one("section[aria-label='Stages side by side']");
  const depth = one("section[aria-label='Depth error']");
  const stations = one("section[aria-label=Stations]");
  const survey = one("section[aria-label='All photographs']");
  const measurements = one("section[aria-label=Measurements]");
  const owned = [
    one(".photo-shelf"), ...all(".steps"), verdict, one("section[aria-label=Matches]"), stages, depth, stations, survey, measurements,
    one("section[aria-label='How the stations fit']"), ...all(".pipeline"), ...all(".pipeline-failure"), one(".job-bar > .clip"),
    one(".job-bar + [role=status]"), one(".export-part"), one(".scan-chip"), one(".self-test"),
  ];
  const telling = /\d|verified|accepted|out of date|contradict|refused|agree/i;
  const rest = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const parent = walker.currentNode.parentElement;
    const said = clean(walker.currentNode.textContent);
    if (!said || !telling.test(said) || parent.closest("script, style, template, noscript, option") || isHidden(parent)) continue;
    if (owned.some((part) => part?.contains(parent))) continue;
    const part = parent.closest(".notice, [popover], dialog, section[aria-label], .pane, header, footer, [id]");
    const name = part?.classList.contains("notice") ? "notice" : part?.getAttribute("aria-label") || part?.id || part?.localName || "";
    rest.push([name, parent.className?.toString() ?? "", said]);
  }
  const camera = one(".camera-button");
  return {
    photo: { text: leaves(one(".photo-button")), title: one(".photo-button")?.title ?? "", level: level(one(".photo-button .sign")),
      hidden: Boolean(one(".photo-button")?.hidden) },
    camera: camera?.hidden ? "" : text(".camera-button"),
    list: all(".photo-entry").map((entry) => ({ id: entry.dataset.photo, text: leaves(entry.querySelector(".photo-text")) })),
    scan: text(".scan-chip"),
    tabs: Object.fromEntries(all(".steps [role=tab]").map((tab) => [tab.id.replace("step-", ""), {
      done: tab.classList.contains("done"), ticked: Boolean(one(".sign svg, .sign .icon", tab)), only: Boolean(one(".sign.only", tab)),
      said: clean(document.getElementById(tab.getAttribute("aria-describedby"))?.textContent ?? ""), title: tab.title,
    }])),
    verdict: {
      label: text(".part-head .dim", verdict), level: level(one(".verdict", verdict)), line: text(".verdict-line", verdict),
      figures: all(".verdict-figure strong", verdict).map((each) => clean(each.textContent)), count: text(".verdict-count", verdict),
      next: leaves(one(".verdict-next", verdict)), evidence: leaves(one(".evidence", verdict)), empty: leaves(verdict),
    },
    chips: all(".matches .filter").filter((chip) => !chip.hidden).map((chip) => clean(chip.textContent)),
    counts: text(".matches .counts"),
    nothing: text(".matches .empty"),
    rows: all(".matches .rows .row-line").map((row) => ({
      id: row.dataset.pick, on: one("input[type=checkbox]", row).checked, number: clean(one(".col-number > span:not(.swatch)", row).textContent),
      mark: one(".mark", row).dataset.mark ?? "", outlier: row.classList.contains("outlier"), disabled: row.classList.contains("disabled"),
      weight: one("input.weight", row).value,
      cells: Object.fromEntries(["kind", "samples", "px", "mm", "depth_m", "influence"].map((name) => [name, text(`.col-${name}`, row)])),
      warns: all(".warns", row).map((cell) => cell.className.match(/col-(\w+)/)[1]),
    })),
    depth: { head: leaves(one(".part-head", depth)), value: one("input.number", depth)?.value ?? "", status: text("[role=status]", depth) },
    stages: {
      heads: all("thead th", stages).map((head) => ({ level: level(one(".sign", head)), text: leaves(head), shown: head.classList.contains("shown") })),
      rows: all("tbody tr", stages).map((row) => [clean(one("th", row).textContent), all("td", row).map((cell) => clean(cell.textContent))]),
      self_test: leaves(one(".self-test")),
    },
    steps: all(".pipeline").flatMap((list) => all(".pipeline-step", list).map((row) => ({
      label: text(".pipeline-name", row), state: row.dataset.state, said: clean(one(".pipeline-status", row).textContent),
    }))),
    job: one(".job-bar")?.hidden ? "" : text(".job-bar > .clip"),
    job_level: level(one(".job-bar > .sign")),
    export: { text: text(".export-part .part-body > [role=status]"), zip: one(".export-part .button.primary")?.disabled ?? null,
      ticks: all(".export-list .sign.ok").length },
    stations: {
      rows: all(".station", stations).map((row) => [".station-name", ".station-state", ".station-where"].map((part) => text(part, row))),
      verdicts: leaves(one(".station-verdicts")), whole: text(".station-fit .acquire-said"),
    },
    measurements: all(".measurement", measurements).map((row) => [
      one(".measurement-name", row).value, text(".measurement-value", row), text("p.dim", row),
      ...all(".measurement-note", row).map((note) => text(note)),
    ]),
    smoothing: {
      hidden: isHidden(one(".smoothing")), applied: one(".smoothing-applied")?.hidden ? "" : text(".smoothing-applied"),
      rows: all(".smoothing-preview .smoothed-range").filter((row) => !isHidden(row)).map((row) => [
        row.dataset.range, text("th", row), ...all("td", row).map((cell) => clean(cell.textContent)),
      ]),
    },
    survey: {
      ties: text("button[aria-label='Draw ties']", survey), count: text(".part-head > .figures", survey), summary: text(".acquire-said", survey),
      rows: all(".survey-photo .survey-row", survey).map((row) => [...row.children].slice(1).map((part) => text(part))),
    },
    notices: all(".notice").map((notice) => clean(notice.textContent)),
    rest,
  };
}
