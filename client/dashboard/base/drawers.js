// The drawers in front of the picture: one is open at a time, beside the tools that open them.

export class Drawers {
  /** @param {HTMLElement} tools with a button[data-drawer=ID] for each drawer, whose [data-close] closes it */
  constructor(tools) {
    /** @type {string | null} the id of the open one */
    this.isOpen = null;
    this.buttons = new Map([...tools.querySelectorAll("[data-drawer]")].map((each) => [each.dataset.drawer, each]));
    for (const [id, button] of this.buttons) {
      button.addEventListener("click", () => this.toggle(id));
      document.getElementById(id).querySelector("[data-close]").addEventListener("click", () => this.close());
    }
  }

  /** @param {string} id */
  toggle(id) {
    if (this.isOpen === id) this.close();
    else this.open(id);
  }

  /** @param {string} id @param {boolean} [takesFocus] false where nobody asked for it */
  open(id, takesFocus = true) {
    this.#show(id);
    if (takesFocus) document.getElementById(id).querySelector("[data-close]").focus();
  }

  /** The focus goes back to the button, if it was in the drawer. */
  close() {
    const before = this.isOpen;
    const hadFocus = before !== null && document.getElementById(before).contains(document.activeElement);
    this.#show(null);
    if (hadFocus) this.buttons.get(before).focus();
  }

  #show(open) {
    this.isOpen = open;
    for (const [id, button] of this.buttons) {
      document.getElementById(id).hidden = id !== open;
      button.setAttribute("aria-expanded", String(id === open));
    }
  }
}
