// What stands in front of the picture steps back while nobody uses it.

const IDLE_AFTER_MS = 5000;
const SIGNS_OF_LIFE = ["pointermove", "pointerdown", "wheel", "keydown", "focusin"];

/**
 * Mark the theatre as idle (data-idle) while it may be, after IDLE_AFTER_MS without a sign of life.
 * @param {HTMLElement} theatre
 * @param {() => boolean} mayStepBack
 */
export function stepBackWhileIdle(theatre, mayStepBack) {
  let timer = 0;
  const wait = () => {
    clearTimeout(timer);
    timer = setTimeout(() => (mayStepBack() ? theatre.toggleAttribute("data-idle", true) : wait()), IDLE_AFTER_MS);
  };
  const wake = () => {
    theatre.toggleAttribute("data-idle", false);
    wait();
  };
  for (const sign of SIGNS_OF_LIFE) document.addEventListener(sign, wake, { capture: true, passive: true });
  wake();
}
