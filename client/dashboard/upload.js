// A file on its way to the service in pieces (tus 1.0), so that a lost connection costs one piece and no more.

import { request } from "./api.js";
import { insist } from "./pause.js";

const TUS = { "Tus-Resumable": "1.0.0" };
const PIECES = 50;
const MIN_PIECE = 256 * 1024;
const MAX_PIECE = 8 * 1024 * 1024;

/** Of a file's name only the ending is sent: the rest may name somebody. */
const suffixOf = (name) => /\.[a-z0-9]+$/.exec(name.toLowerCase())?.[0] ?? "";

export class Upload {
  /**
   * @param {string} part clip, left, right, calibration or masks
   * @param {File} file
   * @param {AbortSignal} signal
   */
  constructor(part, file, signal) {
    this.part = part;
    this.file = file;
    this.signal = signal;
    this.offset = 0;
    /** @type {string | null} where the service takes the bytes */
    this.location = null;
  }

  /** The upload's id, once there is one. */
  get id() {
    return this.location?.split("/").at(-1) ?? null;
  }

  /**
   * Send all of it.
   * @param {() => void} onProgress after each piece
   * @param {(problem: Error) => void} onTrouble while the connection is away
   */
  async send(onProgress, onTrouble) {
    await insist(() => this.#create(), onTrouble, this.signal);
    let isKnown = true; // how far the service has it
    while (this.offset < this.file.size) {
      await insist(async () => {
        if (!isKnown) await this.#ask();
        isKnown = false;
        if (this.offset < this.file.size) await this.#append();
        isKnown = true;
      }, onTrouble, this.signal);
      onProgress();
    }
  }

  /** Give it up. */
  async discard() {
    if (this.location) await request(this.location, { method: "DELETE", headers: TUS }).catch(() => {});
  }

  async #create() {
    const metadata = `part ${btoa(this.part)},suffix ${btoa(suffixOf(this.file.name))}`;
    const headers = { ...TUS, "Upload-Length": String(this.file.size), "Upload-Metadata": metadata };
    const response = await request("/uploads", { method: "POST", headers, signal: this.signal });
    this.location = response.headers.get("Location");
  }

  async #ask() {
    const response = await request(this.location, { method: "HEAD", headers: TUS, signal: this.signal });
    this.offset = Number(response.headers.get("Upload-Offset"));
  }

  async #append() {
    const length = Math.min(MAX_PIECE, Math.max(MIN_PIECE, Math.ceil(this.file.size / PIECES)));
    const response = await request(this.location, {
      method: "PATCH",
      headers: { ...TUS, "Upload-Offset": String(this.offset), "Content-Type": "application/offset+octet-stream" },
      body: this.file.slice(this.offset, this.offset + length),
      signal: this.signal,
    });
    this.offset = Number(response.headers.get("Upload-Offset"));
  }
}
