// The list of jobs: where each stands, cancel, view, delete.

import { cancelJob, deleteScene } from "./api.js";

function element(tag, className = "", text = "") {
  const made = document.createElement(tag);
  made.className = className;
  made.textContent = text;
  return made;
}

function button(text, onClick) {
  const made = element("button", "", text);
  made.type = "button";
  made.addEventListener("click", onClick);
  return made;
}

/** What a job is doing, in one line. */
export function describe(job) {
  if (job.state !== "running") return job.state;
  const parts = [job.cancel_requested ? "cancelling" : (job.stage ?? "starting")];
  if (job.psnr_db != null) parts.push(`${job.psnr_db.toFixed(1)} dB`);
  if (job.seconds_left != null) parts.push(`${Math.round(job.seconds_left)} s left`);
  return parts.join(" · ");
}

function show(job, chosen, actions) {
  const item = element("li", job.id === chosen ? "job chosen" : "job");
  const head = element("div", "head");
  const time = new Date(job.created_at_s * 1000).toLocaleTimeString();
  head.append(element("span", "", `${time} · ${job.id.slice(0, 8)}`), element("strong", "", describe(job)));
  item.append(head);
  if (job.state === "running") {
    const bar = element("progress");
    bar.value = job.fraction ?? 0;
    item.append(bar);
  }
  if (job.error) {
    const { field, problem, remedy } = job.error;
    item.append(element("p", "failed", [field, problem, remedy].filter(Boolean).join(" · ")));
  }
  const row = element("div", "actions");
  if (job.state === "done") row.append(button("View", () => actions.view(job.id)));
  if (job.state === "queued" || job.state === "running") row.append(button("Cancel", () => actions.run(() => cancelJob(job.id))));
  else row.append(button("Delete", () => actions.remove(job.id)));
  item.append(row);
  return item;
}

export function makeJobList(list, nothing, onView, onChange) {
  const actions = {
    view: onView,
    run: async (work) => {
      await work().catch((error) => window.alert(error.message));
      onChange();
    },
    remove: (id) => {
      if (window.confirm("Delete this clip and its scene for good?")) actions.run(() => deleteScene(id));
    },
  };
  let shown = "";
  return (jobs, chosen) => {
    const state = JSON.stringify([jobs, chosen]);
    if (state === shown) return; // leaves focus and half-made clicks alone
    shown = state;
    nothing.hidden = jobs.length > 0;
    list.replaceChildren(...jobs.map((job) => show(job, chosen, actions)));
  };
}
