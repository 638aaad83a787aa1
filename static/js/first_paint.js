/* Set the theme before anything is drawn; no module, since modules wait for the whole page. */
(() => {
  let theme = "system";
  try {
    theme = localStorage.getItem("ladarreg-theme") ?? "system";
  } catch {
    // storage is off: the system's theme
  }
  const light = theme === "light" || (theme === "system" && matchMedia("(prefers-color-scheme: light)").matches);
  document.documentElement.dataset.theme = light ? "light" : "dark";
})();
