// The API key, if the service asks for one: in this tab only, gone with it.

const NAME = "intrasplat-key";

/** Tells "missing" when the service wants a key, or another one, and "changed" when there is another or none. */
export const keyEvents = new EventTarget();

/** @returns {string | null} */
export const currentKey = () => sessionStorage.getItem(NAME);

let isMissing = false;

/** @returns {boolean} whether the service wants a key, or another one than the page has */
export const isKeyMissing = () => isMissing;

function tellChange() {
  isMissing = false;
  keyEvents.dispatchEvent(new Event("changed"));
}

/** @param {string} text */
function keepKey(text) {
  sessionStorage.setItem(NAME, text);
  tellChange();
}

function forgetKey() {
  sessionStorage.removeItem(NAME);
  tellChange();
}

/** @param {string} words why it is asked for */
export function askForKey(words) {
  isMissing = true;
  keyEvents.dispatchEvent(new CustomEvent("missing", { detail: words }));
}

/** @returns {Record<string, string>} */
export function keyHeaders() {
  const key = currentKey();
  return key ? { Authorization: `Bearer ${key}` } : {};
}

/**
 * The form that asks for a key, and the button that forgets it.
 * @param {{form: HTMLFormElement, message: HTMLElement, forget: HTMLButtonElement}} parts
 */
export function showKeyForm({ form, message, forget }) {
  const input = form.querySelector("input");
  const showForget = () => (forget.hidden = !currentKey());
  keyEvents.addEventListener("missing", (event) => {
    message.textContent = event.detail;
    if (form.hidden) {
      form.hidden = false;
      input.focus();
    }
  });
  keyEvents.addEventListener("changed", showForget);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const text = input.value.trim();
    form.reset();
    form.hidden = true;
    if (text) keepKey(text);
  });
  forget.addEventListener("click", forgetKey);
  showForget();
}
