/** What is wrong with the layout now: controls that are clipped, covered, outside of the window, or too small to hit. */
(least) => {
  const CONTROLS = "button, input, select, textarea, summary, a[href], [role=tab], [role=switch]";
  const name = (each) =>
    (each.getAttribute("aria-label") || each.innerText || each.title || each.className || each.localName)
      .trim().split("\n")[0].slice(0, 40);
  const path = (each) => {
    const classes = [...each.classList].slice(0, 2).map((one) => `.${CSS.escape(one)}`).join("");
    return `${each.localName}${each.id ? `#${each.id}` : ""}${classes}`;
  };
  const target = (each) => (each.matches("input[type=checkbox], input[type=radio]") && each.closest("label")) || each;

  /** @returns the part of a control that can be seen; null if it has been scrolled away */
  const seen = (each, box, faults) => {
    let { left, top, right, bottom } = box;
    for (let at = each.parentElement; at && at !== document.body; at = at.parentElement) {
      const style = getComputedStyle(at);
      if (style.position === "fixed") break;
      if (style.overflowX === "visible" && style.overflowY === "visible") continue;
      const edge = at.getBoundingClientRect();
      const beyond = [edge.left - left, edge.top - top, right - edge.right, bottom - edge.bottom];
      const across = beyond[0] > 1 || beyond[2] > 1, along = beyond[1] > 1 || beyond[3] > 1;
      const scrolls = (kind) => kind === "auto" || kind === "scroll";
      if (across && !scrolls(style.overflowX)) faults.push(`clipped at the side by ${path(at)}`);
      if (along && !scrolls(style.overflowY)) faults.push(`clipped above or below by ${path(at)}`);
      [left, top] = [Math.max(left, edge.left), Math.max(top, edge.top)];
      [right, bottom] = [Math.min(right, edge.right), Math.min(bottom, edge.bottom)];
      if (right - left < 4 || bottom - top < 4) return null;
    }
    if (left < -1 || top < -1 || right > innerWidth + 1 || bottom > innerHeight + 1) faults.push("outside of the window");
    return { left, top, right, bottom };
  };

  const found = [];
  let count = 0;
  const dialog = [...document.querySelectorAll("dialog[open], :popover-open")].at(-1);
  for (const each of (dialog ?? document).querySelectorAll(CONTROLS)) {
    if (!each.checkVisibility({ visibilityProperty: true, opacityProperty: true })) continue;
    if (each.closest(".notice, .visually-hidden, .skip") || each.type === "file" || each.type === "hidden") continue;
    const whole = target(each), box = whole.getBoundingClientRect(), faults = [];
    if (box.width === 0 || box.height === 0) continue;
    const part = seen(whole, box, faults);
    if (!part) continue;
    count++;
    if (Math.min(box.width, box.height) < least - 0.5 && each.localName !== "a")
      faults.push(`${box.width.toFixed(0)} x ${box.height.toFixed(0)} px, at least ${least}`);
    const whose = (share) => document.elementFromPoint(
      part.left + share * (part.right - part.left), (part.top + part.bottom) / 2,
    );
    for (const share of [0.25, 0.5, 0.75]) {
      const top = whose(share);
      if (top && !top.closest(".notice") && !whole.contains(top) && !top.contains(whole)) {
        faults.push(`covered by ${path(top)}`);
        break;
      }
    }
    for (const fault of faults) found.push(`${name(each)} (${path(each)}): ${fault}`);
  }
  const wide = document.documentElement.scrollWidth;
  if (wide > innerWidth + 1) found.push(`the page is ${wide} px wide in a window of ${innerWidth}`);
  return { count, found: [...new Set(found)] };
}
