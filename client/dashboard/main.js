// The page: polls the jobs, and wires form, list, picture and report together.

import { getReport, isReady, listJobs } from "./api.js";
import { makeJobList } from "./jobs.js";
import { showReport } from "./report.js";
import { startUploading } from "./uploading.js";
import { Viewer } from "./viewer.js";

const POLL_MS = 1000;
const get = (id) => document.getElementById(id);

const viewer = new Viewer({
  stage: get("stage"),
  frame: get("frame"),
  message: get("stage-message"),
  warning: get("frame-warning"),
  latency: get("latency"),
  time: get("time"),
  timeValue: get("time-value"),
  layer: get("layer"),
  home: get("home"),
  play: get("play"),
});

let awaited = null; // the job whose scene opens by itself when it is done

async function view(id) {
  viewer.open(id);
  try {
    showReport(get("report"), id, await getReport(id));
  } catch (error) {
    get("report").textContent = error.message;
  }
  poll();
}

const showJobs = makeJobList(get("jobs"), get("no-jobs"), view, () => poll());

function showConnection(text, kind) {
  get("connection").textContent = text;
  get("connection").className = `pill ${kind}`;
}

async function poll() {
  try {
    const jobs = await listJobs();
    showJobs(jobs, viewer.scene);
    if (jobs.some((job) => job.id === awaited && job.state === "done")) {
      const id = awaited;
      awaited = null;
      view(id);
    }
    if (viewer.scene && !jobs.some((job) => job.id === viewer.scene)) viewer.open(null);
    const ready = await isReady();
    showConnection(ready ? "ready" : "no worker is ready", ready ? "good" : "bad");
  } catch {
    showConnection("no connection", "bad");
    viewer.refresh(); // which marks the picture as not live
  }
}

startUploading(get("upload"), get("upload-message"), (job) => {
  awaited = job.id;
  if (!viewer.scene) get("stage-message").textContent = "The scene opens here when it is done.";
  poll();
});
setInterval(poll, POLL_MS);
poll();
