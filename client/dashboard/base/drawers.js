// The drawers in front of the picture: one is open at a time, beside the tools that open them.

const MORE_PX = 8;

/** Mark what scrolls while there is more below what is in view (data-more). @param {HTMLElement} drawer */
export function markMore(drawer) {
  const mark = () => {
    const below = drawer.scrollHeight - drawer.scrollTop - drawer.clientHeight;
    drawer.toggleAttribute("data-more", below > MORE_PX);
  };
  drawer.addEventListener("scroll", mark, { passive: true });
  const sizes = new ResizeObserver(mark);
  for (const each of [drawer, ...drawer.children]) sizes.observe(each);
}

export class Drawers {
  /** @param {HTMLElement} tools with a button[data-drawer=ID] for each drawer, whose [data-close] closes it */
  constructor(tools) {
    /** @type {string | null} the id of the open one */
    this.isOpen = null;
    markMore(tools);
    this.buttons = new Map([...tools.querySelectorAll("[data-drawer]")].map((each) => [each.dataset.drawer, each]));
    for (const [id, button] of this.buttons) {
      button.addEventListener("click", () => this.toggle(id));
      markMore(document.getElementById(id));
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
    if (!document.activeElement?.closest(".drawers")) this.opener = document.activeElement;
    this.#show(id);
    if (takesFocus) document.getElementById(id).querySelector("[data-close]").focus();
  }

  /** The focus goes back to where it was, or to the button, if it was in the drawer. */
  close() {
    const before = this.isOpen;
    const hadFocus = before !== null && document.getElementById(before).contains(document.activeElement);
    this.#show(null);
    if (!hadFocus) return;
    const { opener } = this;
    const isThere = opener?.matches("button") && opener.checkVisibility();
    (isThere ? opener : this.buttons.get(before)).focus();
  }

  #show(open) {
    this.isOpen = open;
    for (const [id, button] of this.buttons) {
      document.getElementById(id).hidden = id !== open;
      button.setAttribute("aria-expanded", String(id === open));
    }
  }
}
