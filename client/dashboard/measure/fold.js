// The measuring panel folds, where it is a sheet at the lower edge (style/measuring.css), and shows whether there is more below.

import { markMore } from "../base/drawers.js";

/** @param {HTMLElement} panel with a button.fold */
export function prepareFold(panel) {
  const button = panel.querySelector(".fold");
  button.addEventListener("click", () => {
    const isFolded = panel.toggleAttribute("data-folded");
    button.setAttribute("aria-expanded", String(!isFolded));
  });
  markMore(panel);
}
