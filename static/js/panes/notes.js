/** Texts on a pane and in the status bar: the next action, loading and errors, and what the current tool expects. */

import { button } from "../ui/controls.js";
import { element } from "../ui/dom.js";
import { other } from "./picking.js";

const PANE = { scan: "scan", photo: "photograph" };
const LOADING_SHOWN_AFTER_MS = 300;

/**
 * @param {import("./picking.js").Picking} picking
 * @param {string} tool
 * @param {{readOnly?: boolean, chosen?: boolean}} state whether the page may only look, and whether a single match is
 *   selected
 * @returns {string} for the status bar
 */
export const hintOf = (picking, tool, { readOnly = false, chosen = false } = {}) => {
  if (readOnly) return "Read only: drag to move the picture, click a match to select it";
  const { drawing, open } = picking;
  if (drawing?.clicked) return "Click the other end of the line · Esc cancels";
  if (drawing) return drawing.kind === "line" ? "Release at the other end of the line · Esc cancels" : "Release to set the point · Esc cancels";
  if (open) return partnerHint(picking);
  if (tool !== "select" && chosen) return `Drag an end of the selected match to move it, or draw a new ${tool} elsewhere`;
  if (tool === "line") return "Draw a line in either picture: drag, or click both ends";
  if (tool === "point") return "Click a point in either picture";
  return "Click a match to select it, drag an end to move it; arrow keys move it by 0.1 px";
};

/** @param {{open: import("./picking.js").Drawn | null, acceptable: boolean}} picking @returns {string} for the pane in which the partner is missing */
export const partnerHint = ({ open, acceptable }) => {
  if (!open) return "";
  const where = `Draw the same ${open.kind} in the ${PANE[other(open.side)]}`;
  return acceptable ? `${where}, or press Enter to accept the dashed one · Esc cancels` : `${where} · Esc cancels`;
};

/** The texts on one pane. */
export class Notes {
  #controller;
  #side;
  #slots;
  #middle = element("p", { class: "pane-middle", role: "status" });
  #note = element("p", { class: "pane-note" });
  #spinner = element("div", { class: "pane-spinner", role: "progressbar", hidden: true });
  #partnerText = element("p", { role: "status" });
  #partnerBox = element("div", { class: "pane-partner" }, this.#partnerText);
  #since = 0;
  #timer = 0;

  /**
   * @param {import("./controller.js").Controller} controller
   * @param {import("./pane.js").Pane} pane
   * @param {import("./painting.js").Slots} slots
   */
  constructor(controller, pane, slots) {
    this.#controller = controller;
    this.#side = pane.side;
    this.#slots = slots;
    this.body = pane.body;
    // touch has no Esc key
    const discard = () => {
      controller.abandon();
      pane.body.focus({ preventScroll: true });
    };
    this.#partnerBox.append(button({
      label: "Discard the drawing",
      title: "Discard the drawing (Esc)",
      icon: "close",
      bare: true,
      kind: "pane-button",
      act: discard,
    }));
    this.#spinner.setAttribute("aria-label", `Loading the picture of the ${PANE[pane.side]}`);
    pane.body.append(this.#middle, this.#note, this.#partnerBox, this.#spinner);
  }

  #status() {
    const { picture } = this.#slots;
    const side = this.#controller.sides[this.#side];
    if (side.empty) return side.empty;
    if (picture.error) return picture.error;
    return this.#loadsLong() && !picture.shown ? "Loading the picture …" : "";
  }

  /** @returns {boolean} whether something has been loading for a moment; the texts are updated when it has */
  #loadsLong() {
    const loading = this.#slots.picture.loading || Boolean(this.#slots.compare?.loading);
    if (!loading) this.#since = 0;
    if (!loading) return false;
    this.#since ||= performance.now();
    const left = this.#since + LOADING_SHOWN_AFTER_MS - performance.now();
    if (left <= 0) return true;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.show(), left + 1);
    return false;
  }

  /** Update all texts. */
  show() {
    const { picking, sides } = this.#controller;
    setParagraph(this.#middle, this.#status());
    setParagraph(this.#note, this.#slots.compare?.error ?? sides[this.#side].note ?? "");
    this.#spinner.hidden = !this.#loadsLong();
    const awaited = picking.missingSide === this.#side && !picking.drawing;
    setParagraph(this.#partnerText, awaited ? partnerHint(picking) : "");
    this.#partnerBox.hidden = !awaited;
    this.body.classList.toggle("awaits-partner", picking.missingSide === this.#side);
  }
}

/** @param {HTMLElement} paragraph @param {string} text */
const setParagraph = (paragraph, text) => {
  if (paragraph.textContent !== text) paragraph.textContent = text;
  paragraph.hidden = text === "";
};
