// A file on its way to the service in pieces (tus 1.0), so that a lost connection costs one piece and no more, and a
// reload nothing but choosing the file again.

import { request } from "../base/api.js";
import { words } from "../base/messages.js";
import { insist } from "../base/pause.js";

const TUS = { "Tus-Resumable": "1.0.0" };
const PIECES = 50;
const MIN_PIECE = 256 * 1024;
const MAX_PIECE = 8 * 1024 * 1024;
const NOT_FOUND = 404;

/** Of a file's name only the ending is sent: the rest may name somebody. @param {string} name */
export const suffixOf = (name) => /\.[a-z0-9]+$/.exec(name.toLowerCase())?.[0] ?? "";

export class Upload {
  /**
   * @param {{part: string, size: number, location: string | null}} planned clip, left, right, calibration or masks; where
   *   the service takes the bytes, if it has been told of them
   * @param {File | null} file null where all of it has come
   * @param {AbortSignal} signal
   * @param {(location: string) => void} onPlace told where the service takes the bytes
   */
  constructor({ part, size, location }, file, signal, onPlace) {
    Object.assign(this, { part, size, location, file, signal, onPlace });
    this.offset = 0;
  }

  /** The upload's id, once there is one. */
  get id() {
    return this.location?.split("/").at(-1) ?? null;
  }

  /**
   * Ask how far it has come; nothing of it, if the service does not know it any more.
   * @param {(problem: Error) => void} onTrouble while the connection is away
   */
  async find(onTrouble) {
    if (this.location !== null) await insist(() => this.#ask(), onTrouble, this.signal);
  }

  /**
   * Send what is left of it.
   * @param {() => void} onProgress after each piece
   * @param {(problem: Error) => void} onTrouble while the connection is away
   */
  async send(onProgress, onTrouble) {
    let isKnown = true; // how far the service has it
    while (this.offset < this.size) {
      await insist(async () => {
        if (this.location === null) await this.#create();
        else if (!isKnown) await this.#ask();
        isKnown = false;
        if (this.location !== null && this.offset < this.size) await this.#append();
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
    const headers = { ...TUS, "Upload-Length": String(this.size), "Upload-Metadata": metadata };
    const response = await request("/uploads", { method: "POST", headers, signal: this.signal });
    this.location = response.headers.get("Location");
    this.onPlace(this.location);
  }

  async #ask() {
    try {
      const response = await request(this.location, { method: "HEAD", headers: TUS, signal: this.signal });
      this.offset = Number(response.headers.get("Upload-Offset"));
    } catch (error) {
      if (error.status !== NOT_FOUND) throw error;
      this.location = null;
      this.offset = 0;
    }
  }

  async #append() {
    const length = Math.min(MAX_PIECE, Math.max(MIN_PIECE, Math.ceil(this.size / PIECES)));
    const response = await request(this.location, {
      method: "PATCH",
      headers: { ...TUS, "Upload-Offset": String(this.offset), "Content-Type": "application/offset+octet-stream" },
      body: await this.#read(length),
      signal: this.signal,
    });
    this.offset = Number(response.headers.get("Upload-Offset"));
  }

  /** The bytes that follow; not left to fetch, which takes a file that cannot be read for a lost connection. */
  async #read(length) {
    try {
      return await this.file.slice(this.offset, this.offset + length).arrayBuffer();
    } catch {
      throw new Error(words("upload.changed"));
    }
  }
}
