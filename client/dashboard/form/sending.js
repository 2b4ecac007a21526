// One clip on its way: its files are uploaded one after the other and become a job. The plan of it survives a reload, which
// files do not: what has not come is asked for again.

import { reconstruct } from "../base/api.js";
import { insist } from "../base/pause.js";
import { readTabStorage, writeTabStorage } from "../base/storage.js";
import { Upload } from "./upload.js";

const STORED_AS = "intrasplat-sending";

/**
 * A file of a plan: by name, size and time it is known again; the name stays in this tab.
 * @typedef {{part: string, name: string, size: number, lastModified: number, location: string | null}} PlannedFile
 */
/**
 * @typedef {{key: string, submission: Record<string, any>, files: PlannedFile[]}} Plan key: of the submission, the same for
 *   every try; submission: all that is sent beside the files
 */

/** An id for one submission; not randomUUID, which browsers keep from pages without HTTPS. */
const newKey = () => [...crypto.getRandomValues(new Uint32Array(4))].map((number) => number.toString(16)).join("-");

/** @returns {Plan | null} what a reload interrupted in this tab */
export const interrupted = () => readTabStorage(STORED_AS);

/** @param {PlannedFile} planned @param {File | undefined} file @returns {boolean} whether it is the one that was being sent */
export const isSame = (planned, file) =>
  file !== undefined && file.name === planned.name && file.size === planned.size && file.lastModified === planned.lastModified;

/**
 * @param {Map<string, File>} files by part
 * @param {Record<string, any>} submission
 * @returns {Plan}
 */
export function planOf(files, submission) {
  const planned = [...files].map(([part, { name, size, lastModified }]) => ({ part, name, size, lastModified, location: null }));
  return { key: newKey(), submission, files: planned };
}

export class Sending {
  /**
   * @param {Plan} plan
   * @param {AbortSignal} signal
   * @param {{onShare: (share: number) => void, onTrouble: (problem: Error) => void}} told
   */
  constructor(plan, signal, told) {
    Object.assign(this, { plan, signal, ...told });
    this.uploads = plan.files.map((planned) => new Upload(planned, null, signal, (location) => this.#note(planned, location)));
    writeTabStorage(STORED_AS, plan);
  }

  /** @returns {Promise<PlannedFile[]>} the files of which something has not come */
  async missing() {
    for (const upload of this.uploads) await upload.find(this.onTrouble);
    return this.plan.files.filter((_, place) => this.uploads[place].offset < this.uploads[place].size);
  }

  /**
   * Send what has not come, and make it a job.
   * @param {Map<string, File>} files by part
   * @returns {Promise<string>} the job's id
   */
  async run(files) {
    for (const upload of this.uploads) upload.file = files.get(upload.part) ?? null;
    this.#tell();
    for (const upload of this.uploads) await upload.send(() => this.#tell(), this.onTrouble);
    const id = await insist(() => this.#submit(), this.onTrouble, this.signal);
    writeTabStorage(STORED_AS, null);
    return id;
  }

  /** Give it up. */
  discard() {
    writeTabStorage(STORED_AS, null);
    for (const upload of this.uploads) upload.discard();
  }

  async #submit() {
    const submission = { ...this.plan.submission };
    for (const upload of this.uploads) submission[upload.part] = upload.id;
    try {
      return (await reconstruct(submission, this.plan.key, this.signal)).id;
    } catch (error) {
      if (error.status === 503 && error.document.job_id) return error.document.job_id; // safe, and queued later
      throw error;
    }
  }

  #tell() {
    const sum = (name) => this.uploads.reduce((total, upload) => total + upload[name], 0);
    this.onShare(this.uploads.length > 0 ? sum("offset") / sum("size") : 1); // a clip that is used again may need no file
  }

  #note(planned, location) {
    planned.location = location;
    writeTabStorage(STORED_AS, this.plan);
  }
}
