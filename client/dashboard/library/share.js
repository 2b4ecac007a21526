// What can be handed on of the scene in view: a link that opens it, playing and rocking or as it is, and one file.

import { exportScene } from "../base/api.js";
import { setText } from "../base/element.js";
import { languageEvents, words } from "../base/messages.js";
import { download } from "./downloads.js";

export class Share {
  /**
   * @param {HTMLDialogElement} dialog
   * @param {import("../base/scopes.js").Scopes} scopes
   * @param {{link: (isMoving: boolean) => string, scene: () => string | null}} of the view
   */
  constructor(dialog, scopes, { link, scene }) {
    const part = (css) => dialog.querySelector(css);
    Object.assign(this, { dialog, scopes, link, scene, text: part(".link"), moves: part(".moves"), message: part(".message") });
    Object.assign(this, { file: part(".file"), frames: part(".frames") });
    part("[data-close]").addEventListener("click", () => dialog.close());
    part(".copy").addEventListener("click", () => this.#copy());
    this.moves.addEventListener("change", () => this.#show());
    this.file.addEventListener("click", () => this.#save());
    dialog.addEventListener("click", (event) => event.target === dialog && dialog.close()); // beside it
    languageEvents.addEventListener("changed", () => this.#show());
  }

  open() {
    if (this.scene() === null) return;
    this.#show();
    this.file.hidden = this.frames.closest("p").hidden = !this.scopes.has("download");
    this.dialog.showModal();
    this.text.select();
  }

  #show() {
    this.text.value = this.link(this.moves.checked);
    this.message.classList.remove("bad");
    setText(this.message, "");
  }

  #save() {
    const wanted = { format: "html", ...(this.frames.checked ? {} : { recorded: "off" }) };
    download(() => exportScene(this.scene(), wanted), this.message);
  }

  async #copy() {
    this.text.select();
    try {
      await navigator.clipboard.writeText(this.text.value);
      setText(this.message, words("share.copied"));
    } catch {
      setText(this.message, words("share.by_hand")); // pages without HTTPS have no clipboard
    }
  }
}
