// How far to trust what is in view: the verdict of the scene's report beside the status word, and at the lower edge the
// warnings of the view, then those of its scene.

import { setText } from "../base/element.js";
import { languageEvents, words } from "../base/messages.js";
import { reasonsIn } from "../library/report.js";
import { lightMark, trustOf } from "../library/trustlight.js";
import { warningsOf } from "./pictures.js";

const TRAINING_GOES_ON = "training_goes_on";

export class Verdict {
  /**
   * @param {import("./viewer.js").Viewer} viewer
   * @param {{verdict: HTMLButtonElement, warning: HTMLElement}} parts
   * @param {() => void} onOpen somebody asks for the reasons
   */
  constructor(viewer, { verdict, warning }, onOpen) {
    Object.assign(this, { viewer, verdict, warning });
    verdict.addEventListener("click", onOpen);
    viewer.addEventListener("shown", () => this.#warn());
    viewer.addEventListener("gone", () => this.know(null));
    languageEvents.addEventListener("changed", () => this.know(this.report));
    this.know(null);
  }

  /** @param {import("../base/wire.js").Report | null} report of the scene in view; null while there is none */
  know(report) {
    this.report = report;
    const trust = report && trustOf(report);
    this.reasons = report ? reasonsIn(report, trust) : [];
    this.verdict.hidden = report === null;
    this.verdict.className = trust?.light ?? "";
    this.verdict.replaceChildren(...(trust ? [lightMark(trust.light)] : []));
    this.verdict.title = words("light.why");
    this.#warn();
  }

  #warn() {
    const { shown, screen } = this.viewer;
    const isOfModel = shown !== null && !screen.shown?.isRecorded;
    const codes = (screen.shown?.codes ?? []).filter((code) => code !== TRAINING_GOES_ON || screen.work === "");
    setText(this.warning, isOfModel ? warningsOf(codes, shown, this.reasons).join(" ") : "");
    this.warning.toggleAttribute("data-of-scene", screen.shown?.codes.length === 0);
    this.warning.title = this.warning.textContent;
  }
}
