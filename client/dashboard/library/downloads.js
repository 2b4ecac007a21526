// The menu of files that a scene can be saved as, in plain words, and the saving itself.

import { exportScene, listExports } from "../base/api.js";
import { button, element } from "../base/element.js";
import { words } from "../base/messages.js";
import { showProblem } from "../base/problem.js";
import { save } from "../base/save.js";

/** The formats of docs/export.md, and views of videos; those of one moment are of the one in view. The scene itself is for
 * keys that may download it. */
const GROUPS = {
  moment: [["mesh-glb"], ["mesh-ply"], ["mesh-stl"], ["points"], ["ply"], ["splat"], ["gltf"], ["mp4", "rock"]],
  clip: [["mp4"], ["mp4", "rock"], ["mp4", "orbit"], ["mp4", "stereo"], ["webm"], ["depth"], ["tracks"], ["ply-zip"], ["tum"]],
  itself: [["html"], ["scene"]],
};

/** @typedef {import("../base/wire.js").ExportOffer} ExportOffer */

/**
 * Save a file, and say how that goes.
 * @param {() => Promise<{blob: Blob, name: string}>} load
 * @param {HTMLElement} message
 */
export async function download(load, message) {
  message.classList.remove("bad");
  message.replaceChildren(element("p", { text: words("download.making") }));
  try {
    const { blob, name } = await load();
    save(name, blob);
    message.replaceChildren();
  } catch (error) {
    showProblem(message, error);
  }
}

/** @param {ExportOffer} offer @param {string} [view] @returns {string} why it cannot be made; empty if it can */
function whyNot(offer, view) {
  if (offer.needs) return words("download.needs", { what: offer.needs });
  return view && !offer.views.includes(view) ? words("download.no_stereo") : "";
}

export class Downloads {
  /**
   * @param {HTMLDialogElement} dialog
   * @param {HTMLElement} message
   * @param {import("../base/scopes.js").Scopes} scopes
   * @param {(id: string) => {t: number, seconds: string}} momentOf the moment in view of a scene, the first of any other
   */
  constructor(dialog, message, scopes, momentOf) {
    Object.assign(this, { dialog, message, scopes, momentOf });
    dialog.addEventListener("click", (event) => {
      if (event.target === dialog) dialog.close(); // beside it
    });
  }

  /** @param {string} id @param {string} name of the scene, as people call it */
  async open(id, name) {
    const moment = this.momentOf(id);
    const t = Number(moment.t.toFixed(4));
    const close = button(words("download.close"), () => this.dialog.close());
    const offered = element("div", { class: "message" });
    this.dialog.setAttribute("aria-label", words("download.title", { name }));
    this.dialog.replaceChildren(
      element("header", {}, element("h2", { text: words("download.title", { name }) }), close),
      offered,
      element("p", { class: "quiet", text: words("download.research") }),
    );
    this.dialog.showModal();
    try {
      const offers = new Map((await listExports(id)).map((offer) => [offer.format, offer]));
      offered.replaceWith(
        ...this.#group("moment", id, offers, { t }, moment.seconds),
        ...this.#group("clip", id, offers),
        ...(this.scopes.has("download") ? this.#group("itself", id, offers) : []),
      );
    } catch (error) {
      showProblem(offered, error);
    }
  }

  #group(group, id, offers, moment = {}, seconds = "") {
    const isFirst = moment.t === 0;
    const title = words(isFirst ? "download.first" : `download.${group}`, { seconds });
    const known = GROUPS[group].filter(([format]) => offers.has(format));
    const buttons = known.map(([format, view]) => {
      const offer = offers.get(format);
      const why = whyNot(offer, view);
      const text = `${words(`download.${[format, view].filter(Boolean).join("-")}`)} (.${offer.file_name.split(".").at(-1)})`;
      const made = button(text, () => this.#save(id, { format, view, ...moment }));
      Object.assign(made.dataset, { format, view: view ?? "" });
      made.disabled = why !== "";
      if (why) made.append(" ", element("small", { text: why }));
      made.removeAttribute("aria-label"); // its text says it all
      return made;
    });
    return [element("h3", { text: title }), element("div", { class: "kinds" }, ...buttons)];
  }

  #save(id, wanted) {
    this.dialog.close();
    download(() => exportScene(id, wanted), this.message);
  }
}
