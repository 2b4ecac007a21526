// What this tab remembers over a reload: gone with the tab, so that no name of a file stays on a machine that is shared.

/** @param {string} name @returns {any} null if nothing is kept, or the browser keeps nothing */
export function kept(name) {
  try {
    return JSON.parse(sessionStorage.getItem(name));
  } catch {
    return null;
  }
}

/** @param {string} name @param {unknown} value null forgets it */
export function keep(name, value) {
  try {
    if (value === null) sessionStorage.removeItem(name);
    else sessionStorage.setItem(name, JSON.stringify(value));
  } catch {
    // it holds until the page is closed
  }
}
