// The service's routes that this page uses. What goes wrong is thrown as a Problem.

import { askForKey, currentKey, keyHeaders } from "./key.js";
import { connectionLost, Problem, problemOf, wrongKeyWords } from "./problem.js";
import { nameIn } from "./save.js";

/** @typedef {import("./wire.js").JobView} Job */
/**
 * What a purge removed.
 * @typedef {{job_id: string, purged_at: string, files: Record<string, number>, bytes: Record<string, number>,
 *   record: boolean, verified: boolean, clip_kept_by: string[]}} Receipt
 */

/**
 * A finished scene in the list.
 * @typedef {{id: string, label?: string | null, created_at_s: number, scored: boolean, psnr_tissue_db?: number | null,
 *   warnings: string[], duration_s?: number | null, error?: string | null}} SceneSummary
 */
/**
 * What a list is narrowed to, and which page of it is asked for.
 * @typedef {{q?: string, cursor?: string, limit?: number, created_from_s?: number, created_until_s?: number}} Search
 */

const NOT_MODIFIED = 304;
/** A service that says nothing for so long is not there. */
export const SILENCE_MS = 5000;

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
  if (response.ok || response.status === NOT_MODIFIED) return response;
  const problem = await problemOf(response);
  if (problem.status === 401 && sent === currentKey()) askForKey(sent ? wrongKeyWords(problem) : problem.message);
  throw problem;
}

const json = async (path, options) => bodyOf(await request(path, options));
const blob = async (path, options) => bodyOf(await request(path, options), "blob");

/** The body of an answer, which may break off. @param {Response} response @param {"json"|"blob"|"text"} kind */
export async function bodyOf(response, kind = "json") {
  try {
    return await response[kind]();
  } catch {
    throw connectionLost();
  }
}

/** @param {Record<string, string | number | undefined>} values what is undefined or "" is left out */
const queryOf = (values) =>
  new URLSearchParams(Object.entries(values).filter(([, value]) => value !== undefined && value !== ""));

/** @returns {Promise<{tenant: string, scopes: string[], key_id: string | null}>} */
export const getKey = () => json("/key");
/** The last answer of listJobs(), which the service need not send again while nothing changes. */
let listed = { path: "", key: null, tag: "", answer: { jobs: [], next: null } };
/**
 * A page of the jobs, newest first.
 * @param {Search} search
 * @returns {Promise<{jobs: Job[], next: string | null}>} next: the cursor of the page after it
 */
export async function listJobs(search) {
  const path = `/jobs?${queryOf(search)}`;
  const isKnown = listed.path === path && listed.key === currentKey();
  const response = await request(path, { headers: isKnown ? { "If-None-Match": listed.tag } : {} });
  if (response.status === NOT_MODIFIED) return { ...listed.answer };
  const answer = { jobs: await bodyOf(response), next: response.headers.get("X-Intrasplat-Next") };
  listed = { path, key: currentKey(), tag: response.headers.get("ETag"), answer };
  return answer;
}
/** @param {Search} search @returns {Promise<SceneSummary[]>} */
export const listScenes = (search) => json(`/scenes?${queryOf(search)}`);
/** @param {string} id @returns {Promise<Job>} */
export const getJob = (id) => json(`/jobs/${id}`);
/** @param {string} id @returns {Promise<Job>} */
export const cancelJob = (id) => json(`/jobs/${id}`, { method: "DELETE" });
/** @param {string} id @returns {Promise<Job>} */
export const retryJob = (id) => json(`/jobs/${id}/retry`, { method: "POST" });
/** @param {string} id @param {string} label "" removes it @returns {Promise<Job>} */
export const labelJob = (id, label) =>
  json(`/jobs/${id}`, {
    method: "PATCH",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ label: label || null }),
  });
/** @param {string} id @returns {Promise<Blob>} a JPEG; the browser keeps none, for it would outlive a purge */
export const getThumbnail = (id) => blob(`/scenes/${id}/thumbnail`, { cache: "no-store" });
/** @param {string} id @returns {Promise<Receipt>} */
export const purgeScene = (id) => json(`/scenes/${id}`, { method: "DELETE" });
/** @param {string} id @returns {Promise<Record<string, any>>} */
export const getReport = (id) => json(`/scenes/${id}`);
/** @param {string} id @returns {Promise<import("./wire.js").SceneCameras>} */
export const getCameras = (id) => json(`/scenes/${id}/cameras`);
/**
 * @param {string} id
 * @param {Record<string, string | number>} query of GET /scenes/{id}/measure
 * @returns {Promise<import("./wire.js").Measurement>}
 */
export const getMeasurement = (id, query) => json(`/scenes/${id}/measure?${new URLSearchParams(query)}`);
/** @param {string} id @returns {Promise<string>} CSV */
export const getCurve = async (id) => bodyOf(await request(`/scenes/${id}/curve`), "text");
/** @param {string} path @returns {Promise<{blob: Blob, name: string}>} a file to save */
async function file(path) {
  const response = await request(path);
  return { blob: await bodyOf(response, "blob"), name: nameIn(response) };
}
/** @param {string} id @returns {Promise<import("./wire.js").ExportOffer[]>} the formats that it can be saved in */
export const listExports = (id) => json(`/scenes/${id}/exports`);
/**
 * @param {string} id
 * @param {{format: string, view?: string, t?: number}} wanted docs/export.md lists the formats
 */
export const exportScene = (id, wanted) => file(`/scenes/${id}/export?${queryOf(wanted)}`);
/** A zip of the masks that were found. @param {string} id */
export const getMasks = (id) => file(`/scenes/${id}/masks`);
/** @returns {Promise<{version: string, limits: {max_frames: number}}>} */
export const getInfo = () => json("/info");

/**
 * Return if a finished scene is still there for this key; throws as a picture of it would. It costs the service no picture.
 * @param {string} id
 */
export const stillThere = async (id) => {
  const signal = AbortSignal.timeout(SILENCE_MS);
  await request(`/render?scene=${id}`, { headers: { "If-None-Match": "*" }, signal });
};

/** @returns {Promise<Problem | null>} why nothing would be trained now; null if it would */
export async function trouble() {
  try {
    await json("/readyz"); // browsers count an answer's bytes once it is read
    return null;
  } catch (error) {
    if (error instanceof Problem && error.status === 503) return error;
    throw error;
  }
}

/**
 * Something that speaks against a clip; refused: POST /reconstruct would refuse it.
 * @typedef {{field: string, code: string, refused: boolean, problem: string, remedy: string}} Finding
 */
/** @param {Record<string, unknown>} described a clip that is to be sent @returns {Promise<{findings: Finding[]}>} */
export const checkClip = (described) =>
  json("/reconstruct/check", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(described),
  });

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

/**
 * Send a scene that another installation saved.
 * @param {File} file docs/export.md, "scene"
 * @returns {Promise<Job>} done once the scene is found sound
 */
export function importScene(file) {
  const body = new FormData();
  body.append("scene", file, "scene.zip"); // the file's own name may name somebody
  return json("/scenes", { method: "POST", body });
}
