/** The question what becomes of scans that were dropped or chosen: frames, stations, another scan, a project. */

import { store } from "../../net/store.js";
import { listed, scanName } from "../../state/scan_name.js";
import { button } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";

/** @typedef {"frames" | "stations" | "replace" | "new" | null} Choice null: leave them */

/**
 * @param {string[]} names of the scans
 * @param {boolean} uploaded whether they were uploaded: a project can be begun with them, and they can wait
 * @returns {[Choice, string, string][]} the answers, with their labels and what they mean
 */
const answers = (names, uploaded) => {
  const scan = store.get("scan");
  const many = names.length > 1;
  const them = many ? "them" : "it";
  const frames = "The scanner stood still, at the same standpoint";
  const stations = "The same place from elsewhere";
  /** @type {[Choice, string, string][]} */
  const found = scan
    ? [
      ["frames", many ? "Add as frames" : "Add as a frame", `${frames}: accumulated with the scan. Matches, photographs and poses stay.`],
      ["stations", many ? "Add as stations" : "Add as a station", `${stations}: registered to the scan in the step Survey. Matches, photographs and poses stay.`],
      ["replace", "Replace the scan", `Its matches and poses are removed; Undo brings them back.${many ? " The new ones are accumulated to one scan." : ""}`],
    ]
    : [
      ["frames", "Frames of one standpoint", `${frames}: accumulated to one scan.`],
      ["stations", "Stations", `${stations}: the first one is opened, the others are registered to it in the step Survey.`],
    ];
  if (uploaded && scan) found.push(["new", `New project with ${them}`, "This project stays as it is."]);
  found.push([null, uploaded ? `Leave ${them} for later` : "Cancel", ""]);
  return found;
};

/**
 * The question; hidden until it is asked.
 * @returns {{question: HTMLElement, ask: (asked: {scans: string[], said?: string}, act: (choice: Choice) => any,
 *   uploaded?: boolean) => void}} `said`: why the last answer was refused; `act` may return a promise
 */
export const scanQuestion = () => {
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const text = element("p", {});
  const list = element("div", { class: "scan-choices" });
  const question = element(
    "section",
    { class: "file-question", role: "group", "aria-label": "What the scans are", hidden: true },
    wrong,
    text,
    list,
  );
  const show = (/** @type {boolean} */ shown) => {
    question.hidden = !shown;
    question.parentElement?.classList.toggle("asking", shown);
  };
  let asked = 0;
  /**
   * Say that the scans are being read until they are open, or until it is asked again why they cannot be.
   * @param {Choice} choice
   * @param {(choice: Choice) => any} act
   */
  const answer = async (choice, act) => {
    const mine = asked;
    setChildren(list, element("p", { class: "dim", role: "status" }, "Reading …"));
    wrong.hidden = true;
    show(choice !== null);
    await act(choice);
    if (mine === asked) show(false);
  };
  /** @param {{scans: string[], said?: string}} asked @param {(choice: Choice) => any} act */
  const ask = ({ scans, said }, act, uploaded = true) => {
    asked += 1;
    const many = scans.length > 1;
    const scan = store.get("scan");
    setText(wrong, said ? `${said.replace(/\.$/u, "")}.` : "");
    wrong.hidden = !said;
    setText(
      text,
      scan
        ? `The project has a scan, ${scanName(scan)}. What ${many ? "are" : "is"} ${listed(scans)}?`
        : `Are ${listed(scans)} frames of one standpoint, or stations?`,
    );
    text.title = scans.join(", ");
    const rows = answers(scans, uploaded).map(([choice, label, meaning]) => [
      button({
        label,
        kind: choice === null ? "plain" : "",
        act: () => answer(choice, act),
      }),
      element("span", { class: "dim" }, meaning),
    ]);
    setChildren(list, ...rows.flat());
    show(true);
    question.scrollIntoView({ block: "nearest" });
    rows[0][0].focus();
  };
  return { question, ask };
};
