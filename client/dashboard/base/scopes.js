// What the user's key may do, asked once a key: the page offers nothing that would be refused.

import { getKey } from "./api.js";
import { currentKey, keyEvents } from "./key.js";

export class Scopes {
  /** @param {() => void} onChange */
  constructor(onChange) {
    this.onChange = onChange;
    /** @type {Set<string> | null} */
    this.known = null;
    this.isAsking = false;
    keyEvents.addEventListener("changed", () => {
      this.known = null;
      this.#ask();
    });
    this.#ask();
  }

  /** @param {"view"|"reconstruct"|"download"|"purge"|"priority"|"long"} scope @returns {boolean} false while it is not known */
  has(scope) {
    return this.known?.has(scope) ?? false;
  }

  /** Ask again after a failure. */
  refresh() {
    if (this.known === null && !this.isAsking) this.#ask();
  }

  async #ask() {
    const key = currentKey();
    this.isAsking = true;
    try {
      const { scopes } = await getKey();
      if (key !== currentKey()) return; // another is asked about already
      this.known = new Set(scopes);
      this.onChange();
    } catch {
      // asked again with the next look at the jobs
    } finally {
      if (key === currentKey()) this.isAsking = false;
    }
  }
}
