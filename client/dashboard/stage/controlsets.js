// Two sets of controls: the desk's has all there is; the theatre's five large buttons, and nothing that deletes, renames or
// sets. The browser remembers which one is shown; style/theatre.css shows it.

import { onKeys } from "../base/keys.js";
import { languageEvents, words } from "../base/messages.js";
import { readChoice, writeChoice } from "../base/storage.js";

const STORED_AS = "intrasplat-controls";
const SETS = ["desk", "theatre"];
const root = document.documentElement;

/** @param {Iterable<HTMLButtonElement>} buttons that change to the other set */
export function prepareControlSets(buttons) {
  const show = (set) => {
    root.dataset.controls = SETS.includes(set) ? set : SETS[0];
    const other = SETS.find((each) => each !== root.dataset.controls);
    for (const each of buttons) each.textContent = words(`controls.${other}`);
  };
  const change = () => {
    const next = SETS.find((each) => each !== root.dataset.controls);
    show(next);
    writeChoice(STORED_AS, next);
  };
  for (const each of buttons) each.addEventListener("click", change);
  languageEvents.addEventListener("changed", () => show(root.dataset.controls));
  onKeys("controls", { t: [] }, change);
  show(readChoice(STORED_AS));
}
