// Elements of the page, made by script. Text is set as text, so nothing that the service sends becomes markup.

import { language } from "./messages.js";

/**
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {{class?: string, text?: string}} [about]
 * @param {...Node} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function element(tag, about = {}, ...children) {
  const made = document.createElement(tag);
  if (about.class) made.className = about.class;
  if (about.text !== undefined) made.textContent = about.text;
  made.append(...children);
  return made;
}

/**
 * @param {string} text
 * @param {() => void} onClick
 * @param {string} [name] what it does, said in full for screen readers
 * @returns {HTMLButtonElement}
 */
export function button(text, onClick, name = text) {
  const made = element("button", { text });
  made.type = "button";
  made.setAttribute("aria-label", name);
  made.addEventListener("click", onClick);
  return made;
}

/**
 * Draw one thing into a picture of lines.
 * @param {SVGSVGElement} svg
 * @param {string} tag
 * @param {Record<string, string | number>} attributes
 * @param {string} [text]
 */
export function draw(svg, tag, attributes, text = "") {
  const made = document.createElementNS(svg.namespaceURI, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, String(value));
  made.textContent = text;
  svg.append(made);
}

/** Only where it changes, so that screen readers are told once. @param {Element} target @param {string} text */
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

const LOCALES = { en: "en-GB", de: "de-DE" };

/** @param {number} ms since 1970 */
export const clockTime = (ms) => new Date(ms).toLocaleTimeString(LOCALES[language()]);

/** @param {number} ms since 1970 */
export const dateTime = (ms) =>
  new Date(ms).toLocaleString(LOCALES[language()], { dateStyle: "medium", timeStyle: "medium" });
