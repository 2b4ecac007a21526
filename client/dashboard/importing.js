// A scene that another installation saved, chosen from the disk, becomes one of this installation.

import { importScene } from "./api.js";
import { element } from "./element.js";
import { words } from "./messages.js";
import { hush } from "./news.js";
import { showProblem } from "./problem.js";

export class SceneImport {
  /**
   * @param {{ask: HTMLButtonElement, file: HTMLInputElement, message: HTMLElement}} parts
   * @param {(jobId: string) => void} onJob told when the service has the scene
   */
  constructor(parts, onJob) {
    Object.assign(this, parts);
    this.onJob = onJob;
    this.ask.addEventListener("click", () => this.file.click());
    this.file.addEventListener("change", () => this.#send());
  }

  /** @param {import("./scopes.js").Scopes} scopes of the user's key */
  allow(scopes) {
    this.ask.hidden = !scopes.has("reconstruct");
  }

  async #send() {
    const [file] = this.file.files;
    if (!file) return;
    this.ask.disabled = true;
    hush(this.message);
    this.message.append(element("p", { text: words("import.sending") }));
    try {
      const { id } = await importScene(file);
      hush(this.message);
      this.onJob(id);
    } catch (error) {
      showProblem(this.message, error);
    } finally {
      this.file.value = ""; // the same file may be chosen again
      this.ask.disabled = false;
    }
  }
}
