// Server-sent events of one job, read with fetch, because EventSource can send no key.

import { request } from "./api.js";
import { pause } from "./pause.js";
import { connectionLost, Problem } from "./problem.js";

const NO_CONTENT = 204;
const RETRY_MS = 2000;
/** The service sends at least a comment every 15 s. */
const SILENCE_MS = 35000;

/**
 * One event as it came.
 * @typedef {{id: string, type: string, data: string}} ServerEvent
 */

/**
 * Take whole events off a text's front.
 * @param {string} text
 * @returns {[ServerEvent[], string]} the events, and what is left of the text
 */
export function parseEvents(text) {
  const blocks = text.replaceAll("\r\n", "\n").split("\n\n");
  const rest = blocks.pop();
  const events = blocks.map((block) => {
    const event = { id: "", type: "message", data: "" };
    for (const line of block.split("\n")) {
      const [, name, value] = /^(\w+): ?(.*)$/.exec(line) ?? [];
      if (name === "data") event.data += (event.data && "\n") + value;
      else if (name === "event") event.type = value;
      else if (name === "id") event.id = value;
    }
    return event;
  });
  return [events.filter((event) => event.data), rest];
}

/**
 * Follows a job until its end or until it is told to stop; comes again after a lost connection where it was. The end is
 * where the service has nothing more (204): a job that was tried again had ended before, too.
 */
export class JobEvents {
  /**
   * @param {string} id
   * @param {(job: import("./api.js").Job) => void} onJob
   */
  constructor(id, onJob) {
    this.id = id;
    this.onJob = onJob;
    this.controller = new AbortController();
    this.lastId = "";
    this.isOver = false;
    this.#follow();
  }

  stop() {
    this.isOver = true;
    this.controller.abort();
  }

  async #follow() {
    while (!this.isOver) {
      try {
        await this.#readOnce();
      } catch (error) {
        if (error.status === 404 || error.status === 403) this.isOver = true;
        if (!(error instanceof Problem || error.name === "AbortError")) console.error(error); // a fault of this page
      }
      if (!this.isOver) await pause(RETRY_MS, this.controller.signal).catch(() => {});
    }
  }

  async #readOnce() {
    const headers = this.lastId ? { "Last-Event-ID": this.lastId } : {};
    const response = await request(`/jobs/${this.id}/events`, { headers, signal: this.controller.signal });
    if (response.status === NO_CONTENT) {
      this.isOver = true;
      return;
    }
    const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
    let text = "";
    try {
      while (true) {
        const { value, done } = await soon(reader);
        if (done) return;
        const [events, rest] = parseEvents(text + value);
        text = rest;
        for (const event of events) this.#take(event);
      }
    } finally {
      reader.cancel().catch(() => {}); // else the connection stays open beside the next one
    }
  }

  /** @param {ServerEvent} event */
  #take(event) {
    if (event.id) this.lastId = event.id;
    if (event.type !== "job" || this.isOver) return;
    this.onJob(JSON.parse(event.data));
  }
}

/** The next piece; a Problem if the line is lost, or silent, as a dead one is. */
export async function soon(reader) {
  let timer;
  const silence = new Promise((_, reject) => (timer = setTimeout(() => reject(connectionLost()), SILENCE_MS)));
  try {
    return await Promise.race([reader.read(), silence]);
  } catch (error) {
    reader.cancel().catch(() => {});
    throw error instanceof Problem || error.name === "AbortError" ? error : connectionLost();
  } finally {
    clearTimeout(timer);
  }
}
