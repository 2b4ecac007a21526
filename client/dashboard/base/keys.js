// The page's keys: one table, which handles them and of which the help tells.

/**
 * does: what the keys do, as the help's words name it. keys: what each gives to act, by KeyboardEvent.key.
 * @typedef {{does: string, keys: Record<string, any[]>, act: (...given: any[]) => void, withShift: boolean}} KeyRow
 */

/** What is typed into takes all keys; what has keys of its own keeps them. */
const TYPED = "textarea, select, dialog[open], input:not([type=range], [type=checkbox])";
const PRESSED = "button, summary, a, [type=checkbox]";
const OWN = { " ": PRESSED, Enter: PRESSED, PageUp: ".drawer", PageDown: ".drawer" };
const OF_SLIDERS = /^(Arrow|Home)/;
/** Escape closes a drawer from its fields, too; a search with text in it is emptied first. */
const LEFT = ".drawers :not([type=search]:not(:placeholder-shown), dialog[open] *)";
/** Here Space works what has the focus, however it came by it. */
const FILLED_IN = "form, dialog, .drawer";

/** @type {KeyRow[]} */
const rows = [];

/**
 * Let keys do something.
 * @param {string} does words("help.DOES") says what
 * @param {Record<string, any[]>} keys
 * @param {(...given: any[]) => void} act
 * @param {boolean} [withShift] of arrows, which mean something else without it
 */
export function onKeys(does, keys, act, withShift = false) {
  rows.push({ does, keys, act, withShift });
}

/** @returns {readonly KeyRow[]} */
export const keyRows = () => rows;

/** The sign that came last, and the one by which the focus came: "pointerdown" or "keydown". */
let lastSign = "";
let focusCameBy = "";

/** @param {KeyboardEvent} event */
function isForOthers({ key, target, ctrlKey, metaKey, altKey }) {
  if (key === undefined || ctrlKey || metaKey || altKey || !(target instanceof Element)) return true; // autofill tells no key
  if (key === " " && focusCameBy === "pointerdown" && !target.closest(FILLED_IN)) return false;
  if (key === "Escape" && target.matches(LEFT)) return false;
  if (target.closest(TYPED)) return true;
  if (target.closest("[type=range], [role=slider]") && OF_SLIDERS.test(key)) return true;
  return key in OWN && target.closest(OWN[key]) !== null;
}

/** Begin to listen. */
export function listenToKeys() {
  for (const sign of ["pointerdown", "keydown"]) document.addEventListener(sign, () => (lastSign = sign), { capture: true });
  document.addEventListener("focusin", () => (focusCameBy = lastSign), { capture: true });
  let handled = "";
  document.addEventListener("keyup", (event) => event.key === handled && event.preventDefault()); // Firefox presses buttons then
  document.addEventListener("keydown", (event) => {
    handled = "";
    if (isForOthers(event)) return;
    const isArrow = event.key.startsWith("Arrow");
    const row = rows.find(({ keys, withShift }) => event.key in keys && (!isArrow || withShift === event.shiftKey));
    if (!row) return;
    event.preventDefault();
    handled = event.key;
    row.act(...row.keys[event.key]);
  });
}
