/** The tabs Acquire, Survey, Match, Solve, Judge and Export: the progress of the work, and the choice of what the dock shows. */

import { store } from "../../net/store.js";
import { acquireStep } from "../../state/acquisition.js";
import { workSteps } from "../../state/progress.js";
import { stationsStep } from "../../state/stations.js";
import { view } from "../../state/view.js";
import { element, newId, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { lightOf } from "../../ui/lights.js";
import { markChosen, navigateByArrows } from "../../ui/tablist.js";

/** Steps whose tick rests on the verdict. */
const JUDGED = new Set(["solve", "judge"]);

/** @returns {import("../../state/progress.js").WorkStep[]} of the shown photograph */
export const stepsNow = () => [
  acquireStep(),
  stationsStep(),
  ...workSteps(),
];

/** @returns {HTMLElement} */
export const mountStepTabs = () => {
  const list = element("div", { class: "steps", role: "tablist", "aria-label": "Steps" });
  const tabs = new Map();
  for (const { name, label } of stepsNow()) {
    const described = element("span", { id: newId("step"), class: "visually-hidden" });
    const sign = element("span", { class: "sign" });
    const tab = element(
      "button",
      {
        type: "button",
        class: "step",
        role: "tab",
        id: `step-${name}`,
        "aria-controls": "dock",
        "aria-describedby": described.id,
      },
      sign,
      element("span", {}, label),
    );
    tab.addEventListener("click", () => view.set({ step: name }));
    list.append(tab, described);
    tabs.set(name, { tab, described, sign });
  }
  navigateByArrows(list);

  const show = () => {
    for (const { name, done, missing, status } of stepsNow()) {
      const { tab, described, sign } = tabs.get(name);
      tab.classList.toggle("done", done);
      const onMatches = JUDGED.has(name) && store.photo()?.light === "matches_only"; // never the green of what is verified
      sign.classList.toggle("only", onMatches);
      setChildren(sign, done ? icon(onMatches ? lightOf("matches_only").sign : "tick") : null);
      tab.title = [status, missing].filter(Boolean).join("\n");
      setText(described, `${done ? "Done. " : ""}${status} ${missing}`);
    }
    markChosen([...tabs.values()].map(({ tab }) => tab), tabs.get(view.get().step).tab);
  };
  store.watch(["shown", "photos", "progress", "progress:*", "acquisition", "stations"], show);
  view.on((_, changed) => changed.has("step") && show());
  show();
  return list;
};
