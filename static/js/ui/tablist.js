/** Keyboard navigation of a tab list: Tab reaches the chosen tab, arrow keys the others. */

/**
 * Let the arrow keys, Home and End choose a tab.
 * @param {HTMLElement} list with role `tablist`; its tabs have role `tab`
 */
export const navigateByArrows = (list) => {
  list.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    const tabs = /** @type {HTMLElement[]} */ ([...list.querySelectorAll("[role=tab]")]);
    const at = tabs.indexOf(/** @type {HTMLElement} */ (document.activeElement));
    if (at < 0) return;
    const next = event.key === "Home"
      ? 0
      : event.key === "End"
      ? tabs.length - 1
      : step && (at + step + tabs.length) % tabs.length;
    if (next === undefined) return;
    event.preventDefault();
    tabs[next].focus();
    tabs[next].click();
  });
};

/** Mark the chosen tab. @param {HTMLElement[]} tabs @param {HTMLElement | null | undefined} chosen */
export const markChosen = (tabs, chosen) => {
  for (const tab of tabs) {
    tab.setAttribute("aria-selected", String(tab === chosen));
    tab.tabIndex = tab === chosen || (!chosen && tab === tabs[0]) ? 0 : -1;
  }
};
