// A seam between the recorded frame and the model, from the endoscope's own pose, in the file of a scene.

import { setText } from "../base/element.js";
import { words } from "../base/messages.js";
import { RecordedPicture } from "../stage/recordedpicture.js";
import { MIDDLE, Seam } from "../stage/seam.js";

export class Comparison {
  /**
   * @param {{stage: HTMLElement, box: HTMLElement, canvas: HTMLCanvasElement, seam: HTMLElement, ofRecorded: HTMLElement,
   *   ofModel: HTMLElement, button: HTMLElement, tools: HTMLInputElement}} parts
   * @param {import("./recording.js").Recording} recording which has frames
   * @param {boolean} isSteady whether the model has another light than the recording
   */
  constructor(parts, recording, isSteady) {
    Object.assign(this, { parts, recording, isOn: false });
    this.picture = new RecordedPicture(parts.canvas);
    this.seam = new Seam(parts.seam, parts.box);
    parts.button.hidden = false;
    parts.ofModel.textContent = words(isSteady ? "file.model_steady" : "compare.model");
    parts.tools.addEventListener("change", () => this.draw());
  }

  /** @param {boolean} isOn */
  choose(isOn) {
    this.isOn = isOn;
    const { stage, box, canvas, button, tools } = this.parts;
    stage.toggleAttribute("data-compare", isOn);
    if (isOn) stage.dataset.compare = "wipe";
    box.hidden = !isOn;
    canvas.hidden = true; // until its frame is there
    tools.closest("label").hidden = !(isOn && this.recording.hasMasks);
    button.setAttribute("aria-pressed", String(isOn));
    if (isOn) this.seam.move(MIDDLE);
  }

  /** Have the frame that belongs to t. @param {number} t */
  async load(t) {
    if (this.isOn) await this.recording.at(t);
  }

  /** Show the frame that was loaded last. */
  draw() {
    const { last } = this.recording;
    if (!this.isOn || last === null) return;
    const { canvas, ofRecorded, tools } = this.parts;
    this.picture.draw(last, tools.checked);
    const text = words("compare.recorded", { frame: last.frame + 1 });
    setText(ofRecorded, text);
    canvas.setAttribute("aria-label", text);
    canvas.hidden = false;
  }
}
