// A scene that another installation saved, chosen from the disk, becomes one of this installation.

import { importScene } from "../base/api.js";
import { closeBanner } from "../base/banners.js";
import { element } from "../base/element.js";
import { words } from "../base/messages.js";
import { showProblem } from "../base/problem.js";

export class SceneImport {
  /**
   * @param {{ask: HTMLButtonElement, file: HTMLInputElement, message: HTMLElement}} parts
   * @param {(jobId: string) => void} onJob told when the service has the scene
   */
  constructor(parts, onJob) {
    Object.assign(this, parts);
    this.onJob = onJob;
    this.ask.addEventListener("click", () => this.file.click());
    this.file.addEventListener("change", () => this.file.files[0] && this.send(this.file.files[0]));
  }

  /** @param {import("../base/scopes.js").Scopes} scopes of the user's key */
  allow(scopes) {
    this.ask.hidden = !scopes.has("reconstruct");
  }

  /** @param {File} file */
  async send(file) {
    this.ask.disabled = true;
    closeBanner(this.message);
    this.message.append(element("p", { text: words("import.sending") }));
    try {
      const { id } = await importScene(file);
      closeBanner(this.message);
      this.onJob(id);
    } catch (error) {
      showProblem(this.message, error);
    } finally {
      this.file.value = ""; // the same file may be chosen again
      this.ask.disabled = false;
    }
  }
}
