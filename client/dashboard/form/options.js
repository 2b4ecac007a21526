// The options of a reconstruction as fields of the form: their choices and limits are the service's.

import { hasWords, words } from "../base/messages.js";
import { LIMITS } from "../base/wire.js";

export const OPTIONS = [
  ...["preset", "budget_s", "layout", "eyes", "poses", "fov", "priority", "mask_source", "mask_polarity", "keep_recorded"],
];

/** Give the form's fields the choices and limits of the service's options. @param {HTMLFormElement} form */
export function limit(form) {
  for (const name of OPTIONS) {
    const { choices, max, default: chosen } = LIMITS[name];
    const field = form.elements[name];
    if (max !== undefined) field.max = max;
    for (const choice of choices ?? []) field.append(new Option("", choice, choice === chosen, choice === chosen));
  }
  nameChoices(form);
}

/** Say the choices in the page's language. @param {HTMLFormElement} form */
export function nameChoices(form) {
  for (const name of OPTIONS) {
    for (const option of form.elements[name].options ?? []) {
      const place = `choice.${name}_${option.value}`;
      option.text = hasWords(place) ? words(place) : option.value;
    }
  }
}

/** @param {HTMLFormElement} form @returns {Record<string, string | number>} */
export function optionsOf(form) {
  const given = new FormData(form);
  const options = Object.fromEntries(OPTIONS.filter((name) => given.get(name)).map((name) => [name, given.get(name)]));
  if (options.budget_s) options.budget_s = Number(options.budget_s);
  return options;
}

/** Options that the form has no field for, as the job had them. @param {import("../base/api.js").Job | null} job */
export function carriedFrom(job) {
  const options = Object.entries(job?.options ?? {});
  return Object.fromEntries(options.filter(([name, value]) => value != null && !OPTIONS.includes(name)));
}
