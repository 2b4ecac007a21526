// The service's routes that this page uses. What goes wrong is thrown as a Problem.

import { askForKey, currentKey, keyHeaders } from "./key.js";
import { connectionLost, errorWords, Problem, problemOf } from "./problem.js";

/** @typedef {import("./wire.js").JobView} Job */
/**
 * What a purge removed.
 * @typedef {{job_id: string, purged_at: string, files: Record<string, number>, bytes: Record<string, number>,
 *   record: boolean, verified: boolean, clip_kept_by: string[]}} Receipt
 */

/**
 * Ask the service, with the key if there is one.
 * @param {string} path
 * @param {RequestInit} [options]
 * @returns {Promise<Response>}
 */
export async function request(path, options = {}) {
  const sent = currentKey();
  const headers = { ...keyHeaders(), ...options.headers };
  let response;
  try {
    response = await fetch(path, { cache: "no-store", ...options, headers });
  } catch (error) {
    throw error.name === "AbortError" ? error : connectionLost();
  }
  if (response.ok) return response;
  const problem = await problemOf(response);
  if (problem.status === 401 && sent === currentKey()) askForKey(sent ? errorWords("http_401", "wrong") : problem.message);
  throw problem;
}

async function json(path, options) {
  const response = await request(path, options);
  try {
    return await response.json();
  } catch {
    throw connectionLost();
  }
}

/** @returns {Promise<{tenant: string, scopes: string[], key_id: string | null}>} */
export const getKey = () => json("/key");
/** @returns {Promise<Job[]>} */
export const listJobs = () => json("/jobs");
/** @param {string} id @returns {Promise<Job>} */
export const getJob = (id) => json(`/jobs/${id}`);
/** @param {string} id @returns {Promise<Job>} */
export const cancelJob = (id) => json(`/jobs/${id}`, { method: "DELETE" });
/** @param {string} id @returns {Promise<Job>} */
export const retryJob = (id) => json(`/jobs/${id}/retry`, { method: "POST" });
/** @param {string} id @returns {Promise<Receipt>} */
export const purgeScene = (id) => json(`/scenes/${id}`, { method: "DELETE" });
/** @param {string} id @returns {Promise<Record<string, any>>} */
export const getReport = (id) => json(`/scenes/${id}`);
/** @param {string} id @returns {Promise<string>} CSV */
export const getCurve = async (id) => (await request(`/scenes/${id}/curve`)).text();
/** @param {string} id @param {number} t @returns {Promise<Blob>} a .ply */
export const exportScene = async (id, t) => (await request(`/scenes/${id}/export?format=ply&t=${t}`)).blob();

/** @param {string} id @returns {Promise<Blob>} a zip of the masks that were found */
export const getMasks = async (id) => (await request(`/scenes/${id}/masks`)).blob();

/** @returns {Promise<string>} why nothing would be trained now, in words; empty if it would */
export async function trouble() {
  try {
    await request("/readyz");
    return "";
  } catch (error) {
    if (error instanceof Problem && error.status === 503) return error.message;
    throw error;
  }
}

/**
 * Make finished uploads a job.
 * @param {Record<string, unknown>} submission upload ids by part, and options
 * @param {string} idempotencyKey the same for every try
 * @param {AbortSignal} [signal]
 * @returns {Promise<Job>}
 */
export const reconstruct = (submission, idempotencyKey, signal) =>
  json("/reconstruct", {
    method: "POST",
    headers: { "Content-Type": "application/json", "Idempotency-Key": idempotencyKey },
    body: JSON.stringify(submission),
    signal,
  });
