// How well what is seen now can be told from its ground (WCAG 2.1, 1.4.3 and 1.4.11). Controls that are disabled are left
// out, as there; behind a modal dialog nothing is to be read.
() => {
  const TEXT = 4.5;
  const SIGN = 3;
  const STATES = ".wanted, [aria-pressed=true]:not(.plain), .chip[aria-selected=true], [aria-invalid=true], .verdict, .pane-wanted";
  const FIELDS = "input:not([type=checkbox], [type=range], [type=file], .weight, .project-name), select";

  const paint = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const known = new Map();
  /** Any colour of CSS as [r, g, b, a]. */
  const parsed = (text) => {
    if (!known.has(text)) {
      paint.clearRect(0, 0, 1, 1);
      paint.fillStyle = text;
      paint.fillRect(0, 0, 1, 1);
      const [r, g, b, a] = paint.getImageData(0, 0, 1, 1).data;
      known.set(text, [r, g, b, a / 255]);
    }
    return known.get(text);
  };
  const over = ([r, g, b, a], ground) => [r, g, b].map((value, k) => value * a + ground[k] * (1 - a));
  const luminance = (colour) => {
    const [r, g, b] = colour.map((value) => (value / 255 <= 0.04045 ? value / 255 / 12.92 : ((value / 255 + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ratio = (a, b) => {
    const [low, high] = [luminance(a), luminance(b)].sort((x, y) => x - y);
    return (high + 0.05) / (low + 0.05);
  };

  /** Grounds that may lie below: what stands on a picture must do on a black one and on a white one. */
  const grounds = (element) => {
    const layers = [];
    let onPicture = false;
    for (let at = element; at; at = at.parentElement) {
      const colour = parsed(getComputedStyle(at).backgroundColor);
      if (at.classList.contains("pane-body") && layers.length) onPicture = true;
      else if (colour[3] > 0) layers.push(colour);
      if (onPicture || colour[3] === 1) break;
    }
    const bases = onPicture ? [[0, 0, 0], [255, 255, 255]] : [[0, 0, 0]];
    return bases.map((base) => layers.reduceRight((ground, layer) => over(layer, ground), base));
  };
  const opacity = (element) => {
    let share = 1;
    for (let at = element; at; at = at.parentElement) share *= Number(getComputedStyle(at).opacity);
    return share;
  };
  const worst = (element, colour, around) => {
    const [r, g, b, a] = parsed(colour);
    const share = a * opacity(element);
    return Math.min(...grounds(around).map((ground) => ratio(over([r, g, b, share], ground), ground)));
  };

  const named = (element) => {
    const name = (at) => at.localName + (at.id ? `#${at.id}` : "") + [...at.classList].map((each) => `.${each}`).join("");
    return [element.parentElement, element].filter(Boolean).map(name).join(" > ");
  };
  const modal = document.querySelector("dialog:modal");
  const isOff = (element) => element.closest(":disabled, [hidden], .told, .skip, noscript");
  const box = (element) => element.getBoundingClientRect();
  const seen = [...(modal ?? document.body).querySelectorAll("*")].filter(
    (element) =>
      !isOff(element) &&
      element.checkVisibility({ visibilityProperty: true, opacityProperty: true }) &&
      box(element).width > 1 &&
      box(element).height > 1,
  );

  const found = [];
  const check = (element, what, contrast, least) => {
    found.push(contrast);
    if (contrast < least) bad.add(`${contrast.toFixed(2)} < ${least}: ${what} of ${named(element)}`);
  };
  const bad = new Set();
  for (const element of seen) {
    const style = getComputedStyle(element);
    const text = [...element.childNodes].some((node) => node.nodeType === Node.TEXT_NODE && node.data.trim());
    if (element.matches("svg")) check(element, "icon", worst(element, style.color, element), SIGN);
    else if (text || element.value) if (!element.matches("option, progress, input[type=range], input[type=checkbox]"))
      check(element, `“${(element.textContent || element.value).trim().slice(0, 20)}”`, worst(element, style.color, element), TEXT);
    if (element.placeholder && !element.value)
      check(element, "placeholder", worst(element, getComputedStyle(element, "::placeholder").color, element), TEXT);
    const bordered = Number.parseFloat(style.borderTopWidth) > 0 && style.borderTopStyle !== "none";
    if (bordered && element.matches(`${STATES}, ${FIELDS}`))
      check(element, "border", worst(element, style.borderTopColor, element.parentElement), SIGN);
  }
  return { seen: found.length, bad: [...bad] };
}
