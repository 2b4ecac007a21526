// Server-sent events, read with fetch, because EventSource can send no key.

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

/** Reads events until it is told to stop; comes again after a lost connection. */
export class ServerEvents {
  /**
   * @param {string} path
   * @param {{retryMs: number, silenceMs: number}} limits pause before it comes again; longest time without a piece
   */
  constructor(path, { retryMs, silenceMs } = { retryMs: RETRY_MS, silenceMs: SILENCE_MS }) {
    Object.assign(this, { path, retryMs, silenceMs, isOver: false });
    this.controller = new AbortController();
  }

  /** Headers of the next request. @returns {Record<string, string>} */
  headers() {
    return {};
  }

  /** @param {ServerEvent[]} _events that came together */
  take(_events) {}

  /** @param {Error} _error that ended a connection */
  fail(_error) {}

  async start() {
    while (!this.isOver) {
      try {
        await this.#readOnce();
      } catch (error) {
        this.fail(error);
        if (!(error instanceof Problem || error.name === "AbortError")) console.error(error); // a fault of this page
      }
      if (!this.isOver) await pause(this.retryMs, this.controller.signal).catch(() => {});
    }
  }

  stop() {
    this.isOver = true;
    this.controller.abort();
  }

  async #readOnce() {
    const response = await request(this.path, { headers: this.headers(), signal: this.controller.signal });
    if (response.status === NO_CONTENT) {
      this.isOver = true;
      return;
    }
    const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
    let text = "";
    try {
      while (true) {
        const { value, done } = await soon(reader, this.silenceMs);
        if (done) return;
        const [events, rest] = parseEvents(text + value);
        text = rest;
        this.take(events);
      }
    } finally {
      reader.cancel().catch(() => {}); // else the connection stays open beside the next one
    }
  }
}

/**
 * Follows a job until its end or until it is told to stop, from where a lost connection was. The end is where the service
 * has nothing more (204): a job that was tried again had ended before, too.
 */
export class JobEvents extends ServerEvents {
  /**
   * @param {string} id
   * @param {(job: import("./api.js").Job) => void} onJob
   */
  constructor(id, onJob) {
    super(`/jobs/${id}/events`);
    this.onJob = onJob;
    this.lastId = "";
    this.start();
  }

  headers() {
    return this.lastId ? { "Last-Event-ID": this.lastId } : {};
  }

  take(events) {
    for (const event of events) {
      if (event.id) this.lastId = event.id;
      if (event.type === "job" && !this.isOver) this.onJob(JSON.parse(event.data));
    }
  }

  fail(error) {
    if (error.status === 404 || error.status === 403) this.isOver = true;
  }
}

/** The next piece; a Problem if the line is lost, or silent, as a dead one is. */
export async function soon(reader, silenceMs = SILENCE_MS) {
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
