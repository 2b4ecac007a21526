// What went wrong, in words: the service's own, from its problem documents, or ours where it did not answer.

/**
 * A problem document (RFC 9457) as the service sends it.
 * @typedef {{status?: number, detail?: string, field?: string, remedy?: string, job_id?: string,
 *   retry_after_s?: number}} ProblemDocument
 */

/** Words for answers that come without any, from a proxy for instance. */
const WORDS = {
  401: "The service asks for a key.",
  403: "This key may not do that.",
  413: "The file is larger than may be sent.",
  429: "The service is asked too much at once.",
  502: "The service does not answer.",
  503: "The service is not ready.",
};

/** In place of a status: no answer came, or only part of one. */
const LOST = 0;

export class Problem extends Error {
  /**
   * @param {number} status of HTTP; LOST if there was no answer
   * @param {ProblemDocument} [document]
   * @param {number} [retryAfterS] when to ask again, if the service said so
   */
  constructor(status, document = {}, retryAfterS = 0) {
    const detail = document.detail ?? WORDS[status] ?? `The service answered ${status}.`;
    super([document.field && `${document.field}:`, detail, document.remedy].filter(Boolean).join(" "));
    this.status = status;
    this.document = document;
    this.retryAfterS = retryAfterS;
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

/** @returns {Problem} that no answer came */
export const connectionLost = () => new Problem(LOST, { detail: "The connection is lost." });

/**
 * @param {Response} response that is not a success
 * @returns {Promise<Problem>}
 */
export async function problemOf(response) {
  const isProblem = (response.headers.get("Content-Type") ?? "").includes("json");
  const document = isProblem ? await response.json().catch(() => ({})) : {};
  return new Problem(response.status, document, Number(response.headers.get("Retry-After")) || 0);
}
