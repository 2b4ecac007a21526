// The help: every key and gesture there is, from the tables that handle them.

import { element } from "./element.js";
import { GESTURES } from "./gestures.js";
import { keyRows } from "./keys.js";
import { hasWords, language, languageEvents, setLanguage, words } from "./messages.js";

/** @param {string} key of KeyboardEvent */
const nameOf = (key) => (hasWords(`key.${key}`) ? words(`key.${key}`) : key);

/** @param {string[]} names @param {string} does */
function row(names, does, tag) {
  const shown = names.flatMap((name, i) => [...(i ? [document.createTextNode(" ")] : []), element(tag, { text: name })]);
  return element("tr", {}, element("th", {}, ...shown), element("td", { text: words(`help.${does}`) }));
}

function table(title, rows) {
  const caption = element("caption", { text: words(title) });
  return element("table", {}, caption, element("tbody", {}, ...rows));
}

function fill(dialog) {
  const keys = keyRows().map(({ keys: by, does, withShift }) =>
    row([...(withShift ? [words("key.Shift")] : []), ...Object.keys(by).map(nameOf)], does, "kbd"));
  const gestures = Object.entries(GESTURES).map(([name, does]) => row([words(`gesture.${name}`)], does, "span"));
  dialog.querySelector(".help-tables").replaceChildren(table("help.keys", keys), table("help.gestures", gestures));
}

/**
 * Open or close the help.
 * @param {HTMLDialogElement} dialog
 */
export function toggleHelp(dialog) {
  if (dialog.open) return dialog.close();
  fill(dialog);
  dialog.showModal();
}

/** Let choices of a language choose it, and follow one another. @param {Iterable<HTMLSelectElement>} choices */
export function prepareLanguages(choices) {
  const show = () => {
    for (const choice of choices) choice.value = language();
  };
  for (const choice of choices) choice.addEventListener("change", () => setLanguage(choice.value));
  languageEvents.addEventListener("changed", show);
  show();
}

/** Wire the help's dialog. @param {HTMLDialogElement} dialog with a [data-close] and a place for .help-tables */
export function prepareHelp(dialog) {
  languageEvents.addEventListener("changed", () => fill(dialog));
  dialog.querySelector("[data-close]").addEventListener("click", () => dialog.close());
  dialog.addEventListener("keydown", (event) => event.key === "?" && dialog.close());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close()); // beside it
}
