// The buttons of the theatre's set: five, and a few in the scenes. Each does what a control of the desk does, and shows what
// that shows.

import { languageEvents, words } from "../base/messages.js";

const SHOWN = ["aria-pressed", "aria-expanded", "disabled"];

/** @param {ParentNode} nav with buttons whose data-does is the selector of a control; .plays says what a press would do */
export function prepareFive(nav) {
  for (const button of nav.querySelectorAll("[data-does]")) {
    const control = document.querySelector(button.dataset.does);
    const show = () => {
      for (const name of SHOWN.filter((each) => button.hasAttribute(each) || each === "disabled")) {
        if (control.hasAttribute(name)) button.setAttribute(name, control.getAttribute(name));
        else button.removeAttribute(name);
      }
      if (!button.matches(".plays")) return;
      const isPlaying = control.getAttribute("aria-pressed") === "true";
      button.textContent = words(isPlaying ? "live.freeze" : "time.play");
    };
    button.addEventListener("click", () => control.click());
    new MutationObserver(show).observe(control, { attributeFilter: SHOWN });
    languageEvents.addEventListener("changed", show);
    show();
  }
}
