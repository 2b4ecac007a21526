// What speaks against files before they are sent: they are described to the service, which judges by its own rules.

import { checkClip } from "../base/api.js";
import { element } from "../base/element.js";
import { words } from "../base/messages.js";
import { details } from "../base/problem.js";
import { suffixOf } from "./upload.js";

/** @typedef {import("../base/api.js").Finding} Finding */

const HEAD_BYTES = 16;
const MAX_CALIBRATION_BYTES = 250_000;
const VIDEOS = [".mp4", ".mov", ".mkv", ".webm"];
const MISSING = "calibration_missing";
const PARTS_OF_FRAMES = ["clip", "left", "right"];
/** A browser that cannot read a video may never say so. */
const MEASURED_WITHIN_MS = 4000;

/** @type {WeakMap<File, Promise<Record<string, number>>>} */
const measured = new WeakMap();

/** @param {File} file @returns {Promise<Record<string, number>>} width, height and duration as far as the browser can tell */
function measure(file) {
  const video = document.createElement("video");
  const done = new Promise((resolve) => {
    const end = () => {
      const { videoWidth: width, videoHeight: height, duration } = video;
      const size = width > 0 && height > 0 ? { width, height } : {};
      resolve(Number.isFinite(duration) ? { ...size, duration_s: duration } : size);
    };
    video.addEventListener("loadedmetadata", end);
    video.addEventListener("error", end);
    setTimeout(end, MEASURED_WITHIN_MS);
  });
  video.preload = "metadata";
  video.src = URL.createObjectURL(file);
  return done.finally(() => {
    URL.revokeObjectURL(video.src);
    video.removeAttribute("src");
  });
}

/** @param {File} file @returns {Promise<string>} a NUL in place of what is no text */
async function textOf(file) {
  try {
    return new TextDecoder("utf-8", { fatal: true }).decode(await file.arrayBuffer());
  } catch {
    return "\0";
  }
}

/** @param {string} part @param {File} file @returns {Promise<Record<string, unknown>>} as the service wants it */
async function describe(part, file) {
  const head = new Uint8Array(await file.slice(0, HEAD_BYTES).arrayBuffer());
  const suffix = suffixOf(file.name);
  const described = { suffix, size_bytes: file.size, head: [...head].map((byte) => byte.toString(16).padStart(2, "0")).join("") };
  if (part === "calibration") return file.size > MAX_CALIBRATION_BYTES ? described : { ...described, text: await textOf(file) };
  if (!PARTS_OF_FRAMES.includes(part) || !VIDEOS.includes(suffix)) return described;
  if (!measured.has(file)) measured.set(file, measure(file));
  return { ...described, ...(await measured.get(file)) };
}

/**
 * What is no clip needs no calibration. A video of two eyes without one would only fail later, so it is not sent.
 * @param {Finding[]} findings
 */
function toTell(findings) {
  const isNoClip = findings.some(({ field, refused }) => refused && PARTS_OF_FRAMES.includes(field));
  const told = findings.filter(({ code }) => code !== MISSING || !isNoClip);
  return told.map((finding) => ({ ...finding, refused: finding.refused || finding.code === MISSING }));
}

/**
 * Ask the service what speaks against a clip.
 * @param {Map<string, File>} files by part
 * @param {Record<string, any>} submission options, and the job whose clip is used again
 * @returns {Promise<Finding[]>} empty also where the service cannot be asked now
 */
export async function findingsOf(files, { options, clip_of }) {
  const described = { options, clip_of };
  try {
    for (const [part, file] of files) described[part] = await describe(part, file);
    return toTell((await checkClip(described)).findings);
  } catch {
    return []; // it is judged when it is sent
  }
}

/**
 * Show findings beside the fields that they are about, in place of earlier ones.
 * @param {HTMLFormElement} form
 * @param {Finding[]} findings
 * @returns {HTMLElement | null} the first field with something that would be refused
 */
export function showFindings(form, findings) {
  for (const shown of form.querySelectorAll(".finding")) shown.remove();
  let first = null;
  for (const { field, code, refused, problem, remedy } of findings) {
    const name = field.replace(/^options\.?/, "");
    const input = form.elements[{ left: "clip", "": "priority" }[name] ?? name] ?? form.elements.clip;
    const said = element("p", { text: words(`check.${code}`) });
    const finding = element("div", { class: `finding ${refused ? "bad" : "care"}` }, said, ...details(`${problem} ${remedy}`));
    finding.dataset.code = code;
    input.closest("label").after(finding);
    if (refused) first ??= input;
  }
  return first;
}
