// A picture of what is in view, for the record: a PNG with what it shows in lines below it, and in its own texts.

import { getInfo } from "../base/api.js";
import { dateTime } from "../base/element.js";
import { figure, words } from "../base/messages.js";
import { pause } from "../base/pause.js";
import { withTexts } from "../base/png.js";
import { fileName, save } from "../base/save.js";
import { burnMeasurements } from "../measure/burn.js";

/** Narrower pictures are enlarged, so that the lines can be read. */
const MIN_WIDTH_PX = 640;
const LINE_SHARE = 1 / 48;
const LOOK_MS = 50;
const PATIENCE_MS = 10_000;

export class Snapshot {
  /**
   * @param {import("./viewer.js").Viewer} viewer
   * @param {{stage: HTMLElement, recorded: HTMLCanvasElement, ofRecorded: HTMLElement, ofModel: HTMLElement, measured: SVGSVGElement,
   *   button: HTMLButtonElement}} parts measured: as measure/overlay.js draws it
   * @param {import("./compare.js").Compare} compare
   * @param {() => {badge: string, verdict: string, warning: string}} facts of what is in view
   * @param {(text: string) => void} tell what went wrong
   */
  constructor(viewer, parts, compare, facts, tell) {
    Object.assign(this, { viewer, parts, compare, facts, tell });
    parts.button.addEventListener("click", () => this.take());
  }

  /** Hold the moment in view, and save its picture. */
  async take() {
    const { viewer, parts } = this;
    if (!viewer.shown || parts.button.disabled) return;
    parts.button.disabled = true;
    try {
      viewer.timeline.play(false);
      const { version } = await getInfo();
      await this.#rested();
      const texts = this.#texts(version); // of the same moment as the picture
      const canvas = captioned(this.#picture(), texts.Description.split("\n"));
      const name = fileName(`${texts.Title}-${viewer.timeline.momentOf(viewer.shown.t)}`);
      const png = await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
      save(`${name}.png`, withTexts(png, texts));
    } catch (error) {
      this.tell(error.message);
    } finally {
      parts.button.disabled = false;
    }
  }

  /** Wait for the exact picture of the view, and for what it is compared with. */
  async #rested() {
    const { viewer, compare } = this;
    const until = performance.now() + PATIENCE_MS;
    while (viewer.isBusy || viewer.isWanted || viewer.shown?.isMoving || !compare.isCurrent) {
      if (performance.now() > until) throw new Error(words("snapshot.too_slow"));
      await pause(LOOK_MS);
    }
    if (!viewer.shown) throw new Error(words("screen.nothing"));
  }

  /** @param {string} version of the service @returns {Record<string, string>} of the PNG */
  #texts(version) {
    const { shown, timeline, parts } = this.viewer;
    const { badge, verdict, warning } = this.facts();
    const name = this.compare.names;
    const layer = parts.layer.selectedOptions[0].text;
    const light = shown.light === "recorded" ? [words("picture.recorded_light")] : [];
    const guesses = shown.unseen === "guess" ? [words("picture.guesses")] : [];
    const seconds = timeline.momentOf(shown.t);
    const view = [name, seconds, layer, this.viewer.orbit.words, ...guesses, ...light].filter(Boolean).join(" · ");
    const trust = [badge, verdict, warning].filter(Boolean).join(" · ");
    const made = [`intrasplat ${version}`, dateTime(Date.now()), words("page.notice")].join(" · ");
    return {
      Title: name,
      Software: `intrasplat ${version}`,
      "Creation Time": new Date().toISOString(),
      Description: [view, trust, made].filter(Boolean).join("\n"),
      View: JSON.stringify({ ...shown, codes: this.viewer.screen.shown?.codes ?? [], compared: this.compare.compared }),
    };
  }

  /** What the stage shows: the model's picture, the recorded frame over or beside it, with their names, and measurements. */
  #picture() {
    const { canvas } = this.viewer.parts;
    const { stage, recorded, ofRecorded, ofModel, measured } = this.parts;
    const factor = Math.max(1, Math.ceil(MIN_WIDTH_PX / canvas.width));
    const [width, height] = [canvas.width * factor, canvas.height * factor];
    const isBeside = stage.dataset.compare === "side";
    const made = Object.assign(document.createElement("canvas"), { width: isBeside ? 2 * width : width, height });
    const context = made.getContext("2d");
    context.drawImage(canvas, isBeside ? width : 0, 0, width, height);
    const isCompared = stage.dataset.compare !== undefined && !recorded.hidden;
    const shownTo = isBeside ? width : (this.compare.seam.percent / 100) * width;
    if (isCompared) {
      context.save();
      context.beginPath();
      context.rect(0, 0, shownTo, height);
      context.clip();
      context.drawImage(recorded, 0, 0, width, height);
      context.restore();
    }
    const { camera } = this.viewer.shown;
    const place = { left: isBeside ? width : 0, width };
    if (camera) burnMeasurements(context, { svg: measured, canvas, camera }, place);
    if (isCompared) {
      nameSide(context, ofRecorded.textContent, 0, shownTo);
      nameSide(context, ofModel.textContent, shownTo, made.width);
    }
    return made;
  }
}

/**
 * Say at the top of a part of the picture what it is.
 * @param {CanvasRenderingContext2D} context @param {string} text @param {number} left px @param {number} right px
 */
function nameSide(context, text, left, right) {
  const px = letterPx(context.canvas);
  const most = right - left - 2 * px;
  if (most <= 0) return; // nothing of it is in the picture
  Object.assign(context, { font: fontOf(px), textAlign: "start", textBaseline: "top", fillStyle: "#000c" });
  context.fillRect(left + px / 2, px / 2, Math.min(most, context.measureText(text).width) + px, 1.6 * px);
  context.fillStyle = "white";
  context.fillText(text, left + px, 0.8 * px, most);
}

const letterPx = ({ width }) => Math.max(13, Math.round(width * LINE_SHARE));
const fontOf = (px) => `${px}px system-ui, sans-serif`;

/** A picture with lines of text below it. @param {HTMLCanvasElement} picture @param {string[]} lines */
function captioned(picture, lines) {
  const px = letterPx(picture);
  const font = fontOf(px);
  const measure = picture.getContext("2d");
  measure.font = font;
  const wrapped = lines.flatMap((line) => wrap(line, (text) => measure.measureText(text).width < picture.width - 2 * px));
  const made = document.createElement("canvas");
  Object.assign(made, { width: picture.width, height: Math.ceil(picture.height + px * (1.4 * wrapped.length + 1)) });
  const context = made.getContext("2d");
  context.fillRect(0, 0, made.width, made.height);
  context.drawImage(picture, 0, 0);
  Object.assign(context, { font, fillStyle: "white", textBaseline: "top" });
  wrapped.forEach((line, index) => context.fillText(line, px, picture.height + px * (0.6 + 1.4 * index)));
  return made;
}

/** @param {string} text @param {(text: string) => boolean} fits @returns {string[]} lines of whole words */
function wrap(text, fits) {
  const lines = [""];
  for (const word of text.split(" ")) {
    const longer = `${lines.at(-1)} ${word}`.trim();
    if (lines.at(-1) === "" || fits(longer)) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}
