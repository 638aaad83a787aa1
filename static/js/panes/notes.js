/** Sentences on a pane: what to do first, that a picture is coming, why it did not, and what the tool expects here. */

import { element } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { button } from "../ui/controls.js";
import { wantedHint } from "./hints.js";

const LOADING_SAID_AFTER_MS = 300;

/** Notes of one pane. */
export class Notes {
  #desk;
  #side;
  #slots;
  #middle = element("p", { class: "pane-middle", role: "status" });
  #note = element("p", { class: "pane-note" });
  #wanted = element("p", { role: "status" });
  #wantedBox = element("div", { class: "pane-wanted" }, this.#wanted);
  #since = 0;
  #timer = 0;

  /** @param {import("./controller.js").Desk} desk @param {import("./pane.js").Pane} pane @param {{picture: any, compare: any}} slots */
  constructor(desk, pane, slots) {
    this.#desk = desk;
    this.#side = pane.side;
    this.#slots = slots;
    this.body = pane.body;
    // by hand, too: a finger has no Esc
    const drop = () => {
      desk.abandon();
      pane.body.focus({ preventScroll: true });
    };
    this.#wantedBox.append(button("Drop what was drawn", "Drop what was drawn (Esc)", drop, icon("close")));
    pane.body.append(this.#middle, this.#note, this.#wantedBox);
  }

  #said() {
    const { picture } = this.#slots;
    const side = this.#desk.sides[this.#side];
    if (side.empty) return side.empty;
    if (picture.error) return picture.error;
    if (!picture.loading) this.#since = 0;
    if (!picture.loading || picture.picture) return "";
    this.#since ||= performance.now();
    const left = this.#since + LOADING_SAID_AFTER_MS - performance.now();
    if (left <= 0) return "Loading the picture …";
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.show(), left + 1);
    return "";
  }

  /** Say what there is to say now. */
  show() {
    const { picking, sides } = this.#desk;
    put(this.#middle, this.#said());
    put(this.#note, this.#slots.compare?.error ?? sides[this.#side].note ?? "");
    const wanted = picking.wanted === this.#side && !picking.drawing;
    put(this.#wanted, wanted ? wantedHint(picking) : "");
    this.#wantedBox.hidden = !wanted;
    this.body.classList.toggle("wants-partner", picking.wanted === this.#side);
  }
}

const put = (paragraph, text) => {
  if (paragraph.textContent !== text) paragraph.textContent = text;
  paragraph.hidden = text === "";
};

