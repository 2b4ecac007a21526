// Pickers of files in the language of the page: browsers write the text on theirs in the language of their own menus.

import { element, setText } from "./element.js";
import { languageEvents, words } from "./messages.js";

/**
 * Lay this page's text over each picker, which stays where it is and takes clicks, drops and the focus.
 * @param {HTMLFormElement} form
 * @returns {() => void} to be called after a script has put files into one
 */
export function translatePickers(form) {
  const pickers = [...form.querySelectorAll('input[type="file"]')].map((input) => {
    const texts = element("span", { class: "picked" }, element("span", { class: "pick" }), element("span"));
    texts.ariaHidden = "true"; // readers say the browser's own
    const box = element("span", { class: "picker" });
    input.replaceWith(box);
    box.append(input, texts);
    return { input, texts };
  });
  const show = () => {
    for (const { input, texts } of pickers) {
      setText(texts.firstChild, words("form.pick"));
      setText(texts.lastChild, [...input.files].map(({ name }) => name).join(", ") || words("form.picked_none"));
    }
  };
  form.addEventListener("change", show);
  form.addEventListener("reset", () => setTimeout(show)); // it is empty only then
  languageEvents.addEventListener("changed", show);
  show();
  return show;
}
