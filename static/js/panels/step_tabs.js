/** Match, Solve, Judge, Export: where the work stands, and which of them the dock shows. */

import { element, newId, put, say } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { store } from "../net/store.js";
import { choose, walkByArrows } from "../ui/tablist.js";
import { view } from "../state/view.js";
import { workSteps } from "../state/progress.js";

const exported = new Set();

/** @returns {import("../state/progress.js").WorkStep[]} of the shown photograph, now */
export const stepsNow = () =>
  workSteps({
    scan: store.get("scan"),
    photo: store.photo(),
    picks: store.picksOf(),
    poses: store.posesOf(),
    exported: exported.has(store.shown()),
  });

/** @returns {HTMLElement} */
export const mountStepTabs = () => {
  const list = element("div", { class: "steps", role: "tablist", "aria-label": "Steps of the work" });
  const tabs = new Map();
  for (const { name, label } of stepsNow()) {
    const described = element("span", { id: newId("step"), class: "told" });
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
  walkByArrows(list);

  const show = () => {
    for (const { name, done, missing, said } of stepsNow()) {
      const { tab, described, sign } = tabs.get(name);
      tab.classList.toggle("done", done);
      put(sign, done ? icon("tick") : null);
      tab.title = [said, missing].filter(Boolean).join("\n");
      say(described, `${done ? "Done. " : ""}${said} ${missing}`);
    }
    choose([...tabs.values()].map(({ tab }) => tab), tabs.get(view.get().step).tab);
  };
  store.watch(["scan", "photos", "shown", "picks:*", "poses:*"], show);
  store.onEvent("export_ready", ({ photo }) => {
    exported.add(photo);
    show();
  });
  view.on((_, changed) => changed.has("step") && show());
  show();
  return list;
};
