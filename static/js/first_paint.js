/* Set the theme before the first paint, and hide the default pictures if this tab shows others. This is no module, since modules run only after the page is parsed. */
(() => {
  let theme = "system";
  try {
    theme = localStorage.getItem("ladarreg-theme") ?? "system";
  } catch {
    // storage is disabled: the system's theme
  }
  const light = theme === "light" || (theme === "system" && matchMedia("(prefers-color-scheme: light)").matches);
  document.documentElement.dataset.theme = light ? "light" : "dark";
  try {
    document.documentElement.classList.toggle("returning", sessionStorage.getItem("ladarreg-view") !== null);
  } catch {
    // storage is disabled: every visit is the first
  }
})();
