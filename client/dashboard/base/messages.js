// What the page says to people: one table a language, by code. What the service says in words is shown under "details"
// alone, so that nobody at an operating table reads the names of its parts.

import { DE } from "./messages.de.js";
import { EN } from "./messages.en.js";
import { readChoice, writeChoice } from "./storage.js";

const TABLES = { en: EN, de: DE };
const STORED_AS = "intrasplat-language";
/** A table's places: text, and attributes that are read aloud or shown. */
const PLACES = { words: "textContent", wordsLabel: "ariaLabel", wordsTitle: "title", wordsPlaceholder: "placeholder" };

/** Tells "changed" when another language is chosen. */
export const languageEvents = new EventTarget();

const known = [readChoice(STORED_AS), ...navigator.languages].map((each) => each?.slice(0, 2).toLowerCase());
let chosen = known.find((code) => code in TABLES) ?? "en";

/** @returns {"en"|"de"} */
export const language = () => chosen;

/** @param {"en"|"de"} code kept for the next visit */
export function setLanguage(code) {
  chosen = code in TABLES ? code : "en";
  writeChoice(STORED_AS, chosen);
  showWords(document);
  languageEvents.dispatchEvent(new Event("changed"));
}

const lookUp = (place) => {
  const dot = place.indexOf(".");
  return TABLES[chosen][place.slice(0, dot)]?.[place.slice(dot + 1)];
};

/** @param {string} place such as "stage.train" */
export const hasWords = (place) => lookUp(place) !== undefined;

/**
 * @param {string} place a section and a code, such as "stage.train"
 * @param {Record<string, string | number>} [values] for the {names} in it
 * @returns {string} the place itself where the table has none
 */
export function words(place, values = {}) {
  const text = lookUp(place) ?? place;
  return text.replace(/\{(\w+)\}/g, (whole, name) => String(values[name] ?? whole));
}

/** @param {import("./wire.js").Notice} notice @returns {string} the service's words for a code that this page is too old for */
export const noticeWords = ({ code, text }) => lookUp(`notice.${code}`) ?? text;

/** Put the words of `data-words` and its like in their places. @param {ParentNode} root */
export function showWords(root) {
  document.documentElement.lang = chosen;
  for (const [attribute, property] of Object.entries(PLACES)) {
    const dashed = attribute.replace(/[A-Z]/g, (letter) => `-${letter.toLowerCase()}`);
    for (const each of root.querySelectorAll(`[data-${dashed}]`)) each[property] = words(each.dataset[attribute]);
  }
}

/** @param {number} value @param {number} [digits] after the point @returns {string} as the language writes it */
export const figure = (value, digits = 0) =>
  value.toLocaleString(chosen, { minimumFractionDigits: digits, maximumFractionDigits: digits });
