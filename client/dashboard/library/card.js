// One job in the list: its picture, what it is called, when and how long it is, how far to trust it, what may be done.

import { labelJob } from "../base/api.js";
import { button, dateTime, element } from "../base/element.js";
import { figure, words } from "../base/messages.js";
import { apiWords, details, errorWords, showProblem } from "../base/problem.js";
import { lightMark, reasonsOf, trustOf } from "./trustlight.js";

/** As the service has it (contract/wire/labels.py). */
const MAX_LABEL_CHARACTERS = 80;

/** @typedef {import("../base/api.js").Job} Job */
/** @typedef {import("../base/api.js").SceneSummary} SceneSummary */

/** @param {Job} job @returns {string} what people call it */
export const nameOf = (job) => job.label ?? dateTime(job.created_at_s * 1000);

/** @param {SceneSummary} summary @returns {import("./trustlight.js").Trust} */
function trustIn(summary) {
  if (summary.error) return { light: "bad", reasons: [] };
  return trustOf({ ...summary, warnings: summary.warnings.map((code) => ({ code, severity: "warning", text: "" })) });
}

/** The light of a scene and the first reason for care. @param {SceneSummary | null} summary */
function trustLine(summary) {
  if (!summary) return [];
  const trust = trustIn(summary);
  const reason = reasonsOf(trust).find(({ text }) => text !== "")?.text;
  return [element("p", { class: "trust" }, lightMark(trust.light), reason ? element("span", { class: "quiet", text: ` ${reason}` }) : "")];
}

/** @param {Job} job @param {SceneSummary | null} summary @returns {string} when it was sent, and how long its clip is */
function whenAndLong(job, summary) {
  const long = Number.isFinite(summary?.duration_s) ? words("job.long", { seconds: figure(summary.duration_s, 1) }) : "";
  const when = job.label == null ? "" : dateTime(job.created_at_s * 1000);
  return [when, long].filter(Boolean).join(" · ");
}

/**
 * @param {Job} job
 * @param {{summary: SceneSummary | null, buttons: HTMLElement[], thumbnails: import("./thumbnails.js").Thumbnails}} with_
 * @returns {{item: HTMLElement, bar: HTMLProgressElement, words: HTMLElement}}
 */
export function makeCard(job, { summary, buttons, thumbnails }) {
  const name = nameOf(job);
  const state = element("strong", { class: "state" });
  const bar = element("progress");
  bar.setAttribute("aria-label", words("job.progress_of", { name }));
  bar.hidden = job.state !== "running";
  const about = element("div", { class: "about" },
    element("div", { class: "head" }, element("span", { class: "name", text: name }), state),
    element("p", { class: "quiet", text: whenAndLong(job, summary) }),
    ...trustLine(summary),
  );
  const picture = job.state === "done" ? thumbnails.of(job.id) : "";
  const item = element("li", { class: `job ${job.state}` }, element("div", { class: "card" }, picture, about), bar);
  item.dataset.job = job.id;
  if (job.error) {
    const { code, field } = job.error;
    item.append(element("p", { class: "failed", text: errorWords(code ?? "unclassified", field) }), ...details(apiWords(job.error)));
  }
  item.append(element("div", { class: "actions" }, ...buttons));
  return { item, bar, words: state };
}

/**
 * Put a field in place of a job's name, until another one is stored or nothing is to change.
 * @param {HTMLElement} item
 * @param {Job} job
 * @param {(job: Job | null) => void} onEnd the job with its new label; null if it keeps the old one
 */
export function rename(item, job, onEnd) {
  const input = element("input");
  Object.assign(input, { value: job.label ?? "", maxLength: MAX_LABEL_CHARACTERS, ariaLabel: words("label.name") });
  const message = element("div", { class: "message", text: "" });
  const note = element("p", { class: "quiet", text: words("label.no_names") });
  const keep = element("button", { text: words("label.keep") });
  const leave = button(words("label.leave"), () => onEnd(null));
  const form = element("form", { class: "rename" }, input, element("div", { class: "actions" }, keep, leave), note, message);
  form.addEventListener("keydown", (event) => {
    event.stopPropagation(); // keys are letters here
    if (event.key === "Escape") onEnd(null);
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      onEnd(await labelJob(job.id, input.value.trim()));
    } catch (error) {
      showProblem(message, error);
    }
  });
  item.querySelector(".name").replaceWith(form);
  input.focus();
  input.select();
}
