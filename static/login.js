/*
 * Enters the session that was just opened, or the one that this browser already has. Cookies are sent to every port of a
 * host, so a session is a secret path as well; localStorage belongs to one port, and remembers the path.
 */
(async () => {
  const { home, session, access } = document.currentScript.dataset;
  const root = new URL(home, location.href);
  const key = `ladarreg-session ${root.pathname}`;
  // Neither a token nor an expired path stays in the address bar and in the history of the Back button.
  history.replaceState(null, "", root.pathname);

  const remembered = () => {
    try {
      return localStorage.getItem(key)?.match(/^s\/[0-9a-f]{32}\/$/)?.[0] ?? "";
    } catch {
      return ""; // storage is disabled: the bare address leads to the form
    }
  };
  const remember = (path) => {
    try {
      localStorage.setItem(key, path);
    } catch {
      // storage is disabled
    }
  };
  /** What a session permits: "edit", "look", or "" if it has ended. */
  const permitted = async (path) => {
    try {
      const answer = await fetch(new URL(`${path}access`, root), { cache: "no-store", signal: AbortSignal.timeout(5000) });
      return answer.ok ? (await answer.text()).trim() : "";
    } catch {
      return "";
    }
  };

  const kept = remembered();
  document.documentElement.classList.toggle("checking", kept !== "");
  const before = kept && (await permitted(kept));
  // A read-only link opened by someone who may edit takes nothing away.
  const next = before && (before === "edit" || access !== "edit") ? kept : session;
  if (next) {
    remember(next);
    location.replace(new URL(next, root));
    return;
  }
  document.documentElement.classList.remove("checking");
  document.getElementById("token")?.focus();
})();
