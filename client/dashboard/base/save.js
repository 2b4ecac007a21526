// Files for the user's disk.

import { element } from "./element.js";

const KEPT_MS = 10_000;

/** @param {string} name of a scene @returns {string} the same as a file's name, without its ending */
export const fileName = (name) => name.replace(/[^\p{L}\p{N}._-]+/gu, "_");

/** Save under a name. Not a link: a link sends no key. @param {string} name @param {Blob} blob */
export function save(name, blob) {
  const link = element("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), KEPT_MS);
}

/** @param {Response} response @returns {string} what its file is called (RFC 6266) */
export function nameIn(response) {
  const header = response.headers.get("Content-Disposition") ?? "";
  const [, extended] = /filename\*=UTF-8''([^;]+)/.exec(header) ?? [];
  return extended ? decodeURIComponent(extended) : (/filename="([^"]+)"/.exec(header)?.[1] ?? "");
}
