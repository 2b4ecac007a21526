// What went wrong: for people in the page's words, by code; the service's own words are the details.

import { element } from "./element.js";
import { hasWords, words } from "./messages.js";

/**
 * A problem document (RFC 9457) as the service sends it.
 * @typedef {{status?: number, detail?: string, field?: string, remedy?: string, code?: string, job_id?: string,
 *   retry_after_s?: number}} ProblemDocument
 */

/** In place of a status: no answer came, or only part of one. */
const LOST = 0;
/** The code of an error where the service tells only its status. */
const CODES = { [LOST]: "lost", 413: "limit", 422: "input", 501: "missing_extra", 507: "store_full" };

/** @param {string | null} [field] @returns {string} of "options.layout" its group: "options" */
const groupOf = (field) => (field ?? "").split(".")[0];

/**
 * @param {string} code of an error, or "http_" and a status
 * @param {string | null} [field] at fault
 * @returns {string} what it means, in the page's language
 */
export function errorWords(code, field) {
  const found = [`${code}:${groupOf(field)}`, code].find((each) => hasWords(`problem.${each}`));
  return words(`problem.${found ?? "http_other"}`);
}

/** @param {import("./api.js").Job} [job] @returns {string} why nothing comes of it; empty where something does, or may */
export function failureOf(job) {
  if (job?.state === "cancelled") return errorWords("cancelled");
  return job?.state === "failed" ? errorWords(job.error?.code ?? "unclassified", job.error?.field) : "";
}

/** What the service itself says of an error, for whoever runs it. @param {Record<string, any>} error */
export const apiWords = ({ field, detail, problem, remedy }) =>
  [field && `${field}:`, detail ?? problem, remedy].filter(Boolean).join(" ");

export class Problem extends Error {
  /**
   * @param {number} status of HTTP; LOST if there was no answer
   * @param {ProblemDocument} [document]
   * @param {number} [retryAfterS] when to ask again, if the service said so
   */
  constructor(status, document = {}, retryAfterS = 0) {
    super(errorWords(document.code ?? CODES[status] ?? `http_${status}`, document.field));
    this.status = status;
    this.document = document;
    this.retryAfterS = retryAfterS;
    /** What the service said; "" if it said nothing. */
    this.details = apiWords(document);
  }

  /** @returns {number} seconds until it is our turn, where the service is only busy with others; else 0 */
  get turnInS() {
    return this.document.retry_after_s ?? 0;
  }

  /** Whether the same may succeed a little later. */
  get mayPass() {
    return this.status === LOST || this.status === 423 || this.status === 429 || this.status >= 500;
  }
}

/** @param {Problem} problem the answer 401 to a key @returns {string} what is wrong with that key */
export const wrongKeyWords = (problem) => (problem.document.code ? problem.message : errorWords("http_401", "wrong"));

/** @returns {Problem} that no answer came */
export const connectionLost = () => new Problem(LOST);

/**
 * @param {Response} response that is not a success
 * @returns {Promise<Problem>}
 */
export async function problemOf(response) {
  const isProblem = (response.headers.get("Content-Type") ?? "").includes("json");
  const document = isProblem ? await response.json().catch(() => ({})) : {};
  return new Problem(response.status, document, Number(response.headers.get("Retry-After")) || 0);
}

/** The service's own words, closed until somebody opens them. @param {string} text @returns {HTMLElement[]} */
export function details(text) {
  if (!text) return [];
  const said = element("p", { text });
  said.lang = "en";
  return [element("details", { class: "api-words" }, element("summary", { text: words("page.details") }), said)];
}

/**
 * Say what went wrong: in plain words, with the service's own under "details".
 * @param {HTMLElement} target a block, no paragraph
 * @param {Error & {details?: string}} error
 * @param {string} [after] a sentence that follows
 */
export function showProblem(target, error, after = "") {
  const sentence = [error.message, after].filter(Boolean).join(" ");
  target.replaceChildren(element("p", { text: sentence }), ...details(error.details));
  target.classList.add("bad");
}
