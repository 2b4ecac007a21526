// The menu of files that a scene can be saved as, in plain words, and the saving itself.

import { exportScene } from "../base/api.js";
import { button, element } from "../base/element.js";
import { words } from "../base/messages.js";
import { showProblem } from "../base/problem.js";

/** The formats of docs/export.md, and what their files' names end in; those of one moment are of the one in view.
 * The scene itself is for keys that may download it. */
const GROUPS = {
  moment: {
    "mesh-glb": "-mesh.glb",
    "mesh-ply": "-mesh.ply",
    "mesh-stl": "-mesh.stl",
    "points": "-points.ply",
    "ply": ".ply",
    "splat": ".splat",
    "gltf": ".glb",
  },
  clip: {
    "webm": ".webm",
    "mp4": ".mp4",
    "depth": "-depth.npy",
    "tracks": "-tracks.npz",
    "ply-zip": "-ply.zip",
    "tum": ".tum",
  },
  itself: {
    "html": ".html",
    "scene": ".scene.zip",
  },
};
const KEPT_MS = 10_000;

/** @param {string} id of a scene @param {string} format @returns {string} the same for all formats of surfaces */
const kindOf = (id, format) => `${id} ${format.split("-")[0]}`;

/** @param {string} name of a scene @returns {string} the same as a file's name, without its ending */
export const fileName = (name) => name.replace(/[^\p{L}\p{N}._-]+/gu, "_");

/**
 * Save what is loaded under a name. Not a link: a link sends no key.
 * @param {string} name
 * @param {() => Promise<Blob>} load
 */
export async function save(name, load) {
  const link = element("a");
  link.href = URL.createObjectURL(await load());
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), KEPT_MS);
}

/**
 * Save it, and say how that goes.
 * @param {string} name
 * @param {() => Promise<Blob>} load
 * @param {HTMLElement} message
 */
export async function download(name, load, message) {
  message.classList.remove("bad");
  message.replaceChildren(element("p", { text: words("download.making") }));
  try {
    await save(name, load);
    message.replaceChildren();
  } catch (error) {
    showProblem(message, error);
  }
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
    /** @type {Set<string>} scenes and kinds of files that this installation turned out not to make of them */
    this.lacking = new Set();
    dialog.addEventListener("click", (event) => {
      if (event.target === dialog) dialog.close(); // beside it
    });
  }

  /** @param {string} id @param {string} name of the scene, as people call it */
  open(id, name) {
    const moment = this.momentOf(id);
    const t = Number(moment.t.toFixed(4));
    const close = button(words("download.close"), () => this.dialog.close());
    this.dialog.setAttribute("aria-label", words("download.title", { name }));
    this.dialog.replaceChildren(
      element("header", {}, element("h2", { text: words("download.title", { name }) }), close),
      ...this.#group("moment", id, name, t, moment.seconds),
      ...this.#group("clip", id, name),
      ...(this.scopes.has("download") ? this.#group("itself", id, name) : []),
      element("p", { class: "quiet", text: words("download.research") }),
    );
    this.dialog.showModal();
  }

  #group(group, id, name, t, seconds) {
    const isMoment = group === "moment";
    const title = isMoment ? words(t > 0 ? "download.moment" : "download.first", { seconds }) : words(`download.${group}`);
    const buttons = Object.entries(GROUPS[group]).map(([format, suffix]) => {
      const text = `${words(`download.${format}`)} (.${suffix.split(".").at(-1)})`;
      const made = button(text, () => this.#save(id, name, format, suffix, t));
      made.dataset.format = format;
      made.disabled = this.lacking.has(kindOf(id, format));
      if (made.disabled) made.title = words("problem.input:format");
      return made;
    });
    return [element("h3", { text: title }), element("div", { class: "kinds" }, ...buttons)];
  }

  #save(id, name, format, suffix, t) {
    this.dialog.close();
    const load = async () => {
      try {
        return await exportScene(id, { format, t });
      } catch (error) {
        if (error.document?.field === "format") this.lacking.add(kindOf(id, format));
        throw error;
      }
    };
    download(fileName(name) + suffix, load, this.message);
  }
}
