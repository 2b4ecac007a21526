// The recorded frames that lie in the file of a scene: detail for its views, and pictures to compare with.

import { Detail } from "../player/detail.js";
import { nearestPlace } from "../stage/recordedpicture.js";

const EYES = ["left", "right"];
const TYPES = { jpg: "image/jpeg", png: "image/png" };
/** Of the video (intrasplat/scene/recorded_video.py). */
const COLOURS = { matrix: "smpte170m", primaries: "bt709", transfer: "iec61966-2-1", fullRange: true };

/** @param {string} text in base64 @returns {Uint8Array} */
export function bytesOf(text) {
  return Uint8Array.fromBase64?.(text) ?? Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

const nameOf = (eye, frame, kind) => `${EYES[eye]}/${String(frame).padStart(6, "0")}.${kind}`;

export class Recording {
  /**
   * @param {Uint8Array} video detail.mkv; empty if there is none
   * @param {Record<string, string>} pictures recorded frames and masks in base64, by their names in recorded.zip
   */
  constructor(video, pictures) {
    Object.assign(this, { video, pictures, coded: null, last: null });
    const stills = Object.keys(pictures).filter((name) => name.endsWith(".jpg"));
    this.frames = stills.map((name) => Number(name.match(/\d+/)[0]));
    this.hasMasks = Object.keys(pictures).some((name) => name.endsWith(".png"));
  }

  /**
   * Give the player detail, and find the frames of the video.
   * @param {import("../player/player.js").Player} player
   * @throws as Detail.of()
   */
  async open(player) {
    this.frameCount = player.cameras.frameCount;
    if (this.video.length === 0) return;
    player.takeDetail(() => Detail.of(player, this.#source()));
    this.coded = (await player.opening).pictures;
    this.frames = [...new Set([...this.frames, ...this.coded.frames])].sort((a, b) => a - b);
  }

  /**
   * The left eye's frame nearest to t; its pictures are there until another one is asked for.
   * @param {number} t
   * @returns {Promise<{frame: number, picture: ImageBitmap, mask: ImageBitmap | null}>}
   */
  async at(t) {
    const frame = this.frames[nearestPlace(this.frames, this.frameCount, t)];
    if (this.last?.frame === frame) return this.last;
    const mask = this.#blob(nameOf(0, frame, "png"));
    const found = await Promise.all([this.#picture(frame), mask && createImageBitmap(mask)]);
    this.last?.picture.close();
    this.last?.mask?.close();
    return (this.last = { frame, picture: found[0], mask: found[1] });
  }

  async #picture(frame) {
    const still = this.#blob(nameOf(0, frame, "jpg"));
    if (still) return createImageBitmap(still);
    const { width, height, planes } = await this.coded.load(0, frame);
    this.coded.ahead(0, frame);
    const bytes = new Uint8Array(await new Blob(planes).arrayBuffer());
    const { lens } = this.coded.eyes[0];
    const visibleRect = { x: 0, y: 0, width: lens.width, height: lens.height };
    const about = { format: "I420", codedWidth: width, codedHeight: height, visibleRect, timestamp: 0, colorSpace: COLOURS };
    const shown = new VideoFrame(bytes, about);
    return createImageBitmap(shown).finally(() => shown.close());
  }

  #blob(name) {
    const text = this.pictures[name];
    return text === undefined ? null : new Blob([bytesOf(text)], { type: TYPES[name.slice(-3)] });
  }

  /** @returns {import("../player/trainingpictures.js").Source} */
  #source() {
    return {
      bytes: this.video.length,
      read: async (first, end) => this.video.subarray(first, end),
      mask: async (eye, frame) => this.#blob(nameOf(eye, frame, "png")),
    };
  }
}
