// What the browser stores for this page: choices of the user, and for this tab alone what must survive a reload, so that no
// name of a file stays on a shared machine.

/** @param {string} name @returns {string | null} null if nothing is stored, or the browser stores nothing */
export function readChoice(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    return null;
  }
}

/** @param {string} name @param {string} value */
export function writeChoice(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    // it holds until the page is closed
  }
}

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
