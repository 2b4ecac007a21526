// The whole screen for the page, and a screen that does not go dark while there is something to watch.

/** Give the page the whole screen, or take it back. @param {HTMLButtonElement} button pressed while it has it */
export function prepareFullScreen(button) {
  button.hidden = !document.fullscreenEnabled;
  document.addEventListener("fullscreenchange", () => {
    button.setAttribute("aria-pressed", String(document.fullscreenElement !== null));
  });
  const toggle = () => {
    const done = document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen();
    done.catch(() => {}); // the browser does not want to: the page stays as it is
  };
  button.addEventListener("click", toggle);
  return toggle;
}

/** Keeps the screen lit while it shall. */
export class ScreenLight {
  constructor() {
    this.isWanted = false;
    /** @type {WakeLockSentinel | null} */
    this.lock = null;
    document.addEventListener("visibilitychange", () => this.keep(this.isWanted)); // a hidden page loses its lock
  }

  /** @param {boolean} isWanted */
  async keep(isWanted) {
    this.isWanted = isWanted;
    if (!isWanted) {
      const { lock } = this;
      this.lock = null;
      return lock?.release();
    }
    if ((this.lock && !this.lock.released) || this.isAsking || document.hidden || !navigator.wakeLock) return;
    this.isAsking = true;
    try {
      this.lock = await navigator.wakeLock.request("screen");
    } catch {
      this.lock = null; // a flat battery, or not allowed: it goes dark as ever
    } finally {
      this.isAsking = false;
    }
    if (!this.isWanted) this.keep(false);
  }
}
