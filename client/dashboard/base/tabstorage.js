// Values that survive a reload, and end with the tab: no name of a file stays on a shared machine.

/** @param {string} name @returns {any} null if nothing is stored, or the browser stores nothing */
export function readTabStorage(name) {
  try {
    return JSON.parse(sessionStorage.getItem(name));
  } catch {
    return null;
  }
}

/** @param {string} name @param {unknown} value null forgets it */
export function writeTabStorage(name, value) {
  try {
    if (value === null) sessionStorage.removeItem(name);
    else sessionStorage.setItem(name, JSON.stringify(value));
  } catch {
    // it holds until the page is closed
  }
}
