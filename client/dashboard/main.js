// The page: wires form, jobs, picture, curve and report together.

import { Address } from "./base/address.js";
import { getCurve, getReport } from "./base/api.js";
import { closeBanner, prepareBanners } from "./base/banners.js";
import { Drawers } from "./base/drawers.js";
import { setText } from "./base/element.js";
import { prepareFullScreen, ScreenLight } from "./base/fullscreen.js";
import { prepareHelp, prepareLanguages, toggleHelp } from "./base/help.js";
import { currentKey, keyEvents, showKeyForm } from "./base/key.js";
import { listenToKeys, onKeys } from "./base/keys.js";
import { figure, languageEvents, showWords, words } from "./base/messages.js";
import { pause } from "./base/pause.js";
import { failureOf } from "./base/problem.js";
import { fileName, save } from "./base/save.js";
import { Scopes } from "./base/scopes.js";
import { ClipForm } from "./form/form.js";
import { Announcer } from "./library/announce.js";
import { nameOf } from "./library/card.js";
import { drawCurve, pointsOfCsv } from "./library/curve.js";
import { Downloads } from "./library/downloads.js";
import { baselinesOf } from "./library/figures.js";
import { SceneImport } from "./library/importing.js";
import { JobList } from "./library/joblist.js";
import { Jobs } from "./library/jobs.js";
import { Painting } from "./library/painting.js";
import { progressOf, shareOf, shareOfSending, workOn } from "./library/progress.js";
import { showReport } from "./library/report.js";
import { Share } from "./library/share.js";
import { Shelf } from "./library/shelf.js";
import { TimesLeft } from "./library/timeleft.js";
import { listOpenFeeds } from "./live/links.js";
import { Measure } from "./measure/measure.js";
import { csvOf } from "./measure/measurements.js";
import { Probe } from "./measure/probe.js";
import { Compare } from "./stage/compare.js";
import { prepareControlSets } from "./stage/controlsets.js";
import { endFirst } from "./stage/early.js";
import { fitPicture } from "./stage/fit.js";
import { prepareFive } from "./stage/five.js";
import { stepBackWhileIdle } from "./stage/idle.js";
import { Legend } from "./stage/legend.js";
import { drawStrip } from "./stage/lightstrip.js";
import { setMoving } from "./stage/moving.js";
import { Scale } from "./stage/scale.js";
import { comparisonParts } from "./stage/seam.js";
import { Snapshot } from "./stage/snapshot.js";
import { steer } from "./stage/steer.js";
import { Verdict } from "./stage/verdict.js";
import { Viewer } from "./stage/viewer.js";
import { Waiting } from "./stage/waiting.js";

const get = (id) => document.getElementById(id);

const scopes = new Scopes(() => showJobs({ isOther: true })); // the report offers what they allow
export const viewer = new Viewer({
  stage: get("stage"),
  fitted: get("fitted"),
  canvas: get("picture"),
  status: get("status"),
  badge: get("badge"),
  statusText: get("status-text"),
  message: get("stage-message"),
  sceneId: get("scene-id"),
  readout: get("readout"),
  time: get("time"),
  timeValue: get("time-value"),
  layer: get("layer"),
  guess: get("guess"),
  highlights: get("highlights"),
  play: get("play"),
  speed: get("speed"),
  loop: get("loop"),
  loopStart: get("loop-start"),
  loopEnd: get("loop-end"),
  loopAll: get("loop-all"),
  way: get("way"),
}, () => scopes.has("download"), (id) => failureOf(jobs.byId.get(id)));
/** What somebody asked for and cannot have; or, not isBad, has. */
function tell(text, isBad = true) {
  get("address-message").textContent = text;
  get("address-message").classList.toggle("bad", isBad);
}
const handles = { home: get("home"), eye: get("eye"), rock: get("rock"), stepBack: get("step-back"), stepOn: get("step-on") };
steer(viewer, { stage: get("stage"), canvas: get("picture"), ...handles }, tell);

const compare = new Compare(viewer, {
  ...comparisonParts(get),
  mode: get("compare"),
  beside: get("beside"),
  tools: get("compare-tools"),
  message: get("compare-message"),
}, () => address.note());
const over = { stage: get("stage"), canvas: get("picture"), over: get("over") };
new Probe(viewer, over);
new Scale(viewer, { canvas: get("picture"), box: get("scale") });
new Legend(viewer, get("legend"), () => address.note());
const measure = new Measure(viewer, { ...over, button: get("measure"), panel: get("measuring") }, {
  onChange: () => address.note(),
  onSave(measurements) {
    const name = get("scene-id").textContent || viewer.scene;
    save(`${fileName(name)}-measurements.csv`, new Blob([csvOf(name, measurements)], { type: "text/csv" }));
  },
});
const facts = () => ({
  badge: get("badge").textContent,
  verdict: get("verdict").querySelector(".shape + span")?.textContent ?? "",
  warning: get("picture-warning").textContent,
});
const sides = { recorded: get("recorded"), ofRecorded: get("of-recorded"), ofModel: get("of-model") };
const pictured = { ...sides, stage: get("stage"), measured: get("over").querySelector("svg"), button: get("snapshot") };
const snapshot = new Snapshot(viewer, pictured, compare, facts, tell);
const drawers = new Drawers(get("tools"));
const waiting = new Waiting(viewer.screen, { box: get("waiting"), preview: get("preview") });
const times = new TimesLeft();
viewer.addEventListener("shown", () => viewer.scene === waiting.job && waiting.end());
endFirst(viewer);
const verdict = new Verdict(viewer, { verdict: get("verdict"), warning: get("picture-warning") }, () => drawers.open("report-drawer"));

/** @type {string | null} the job that opens by itself as soon as there is something to see of it */
let awaited = null;
/** The scores of a scene follow within seconds. */
const UNSCORED_PAUSE_MS = 1000;
/** @type {string | null} the scene whose report and final curve are shown */
let reported = null;

function say(text) {
  get("report").replaceChildren(Object.assign(document.createElement("p"), { className: "quiet", textContent: text }));
}

function view(id, message) {
  awaited = null;
  reported = null;
  if (id === null || id !== waiting.job) waiting.end();
  tell("");
  closeBanner(get("jobs-message"));
  viewer.open(id, message);
  compare.open(id);
  offerError(null);
  address.note();
  jobs.view(id);
  if (id !== null && drawers.isOpen !== "report-drawer") drawers.close();
  say(words("page.report_of"));
  drawCurve(get("curve"), [], []);
  drawStrip(get("light-strip"), null);
  showJobs();
}

async function report(id) {
  reported = id;
  const isStill = () => viewer.scene === id && reported === id;
  try {
    const found = await getReport(id);
    if (!isStill()) return;
    compare.know(id, found);
    offerError(found);
    verdict.know(found);
    showReport(get("report"), id, found, { maySend: scopes.has("reconstruct"), onMasks: sendAgain, onPaint: (...scene) => painting.open(...scene) });
    drawStrip(get("light-strip"), found.light);
    const csv = await getCurve(id).catch(() => "");
    if (!isStill()) return;
    drawCurve(get("curve"), pointsOfCsv(csv), baselinesOf(found));
    if (found.scored) return;
    await pause(UNSCORED_PAUSE_MS);
    if (isStill()) report(id);
  } catch (error) {
    if (!isStill()) return;
    say(error.message);
    if (error.mayPass) reported = null; // asked for again with the next news of the jobs
  }
}

/** A job that was sent just now. @param {string} id @param {import("./form/sending.js").Plan} [plan] that it was made of */
function expect(id, plan) {
  if (plan) painting.forget(plan);
  awaited = id;
  announcer.await(id);
  if (waiting.isOn) viewer.open(null, "");
  else if (!viewer.scene) viewer.open(null, words("page.awaited"));
  waiting.job = id;
  jobs.poll();
}

/**
 * A clip is being sent: its own first frame is the picture, until there is one of it.
 * @param {File | undefined} clip
 * @param {boolean} isExample the page's own
 */
function send(clip, isExample) {
  waiting.begin(clip, isExample);
  get("empty").hidden = true;
  if (drawers.isOpen === "drawer") drawers.close();
}

/** The bar over the stage: of the job that was sent from here until it is in view, then of the one in view. */
function showProgress() {
  if (form.isSending) return;
  const job = jobs.byId.get(awaited ?? viewer.scene);
  const isUnderWay = job?.state === "queued" || job?.state === "running";
  if (job?.id === waiting.job && (job?.state === "failed" || job?.state === "cancelled")) waiting.end();
  waiting.tell(isUnderWay ? shareOf(job) : null, isUnderWay ? progressOf(job, times) : "");
}

/** @param {string} id @param {"masks"|"calibration"} [part] the file that goes with a job's clip @param {File} [painted] */
function sendAgain(id, part = "masks", painted) {
  const job = jobs.byId.get(id);
  if (!job) return;
  drawers.open("drawer", false);
  if (form.isSending) tell(words("upload.one_at_a_time"));
  else form.sendAgain(job, part, painted);
}

const painting = new Painting(viewer, tell, () => form.isSending, (id, masks) => sendAgain(id, "masks", masks));

function offerMasks() {
  const isOffered = viewer.scene !== null && get("layer").value === "recorded";
  get("better-masks").hidden = !isOffered || !scopes.has("reconstruct");
  get("home").hidden = isOffered; // recorded frames are the endoscope's
}

viewer.addEventListener("uncompared", ({ detail }) => tell(detail));
/** Errors are those against recorded frames. @param {{recorded: object | null} | null} known a scene's report */
function offerError(known) {
  const layer = get("layer");
  layer.querySelector("[value=error]").disabled = !known?.recorded;
  if (known && !known.recorded && layer.value === "error") viewer.look({ layer: "rgb" });
}

let isOpened = false;

/** Once the jobs are known: open the newest scene, if nothing else is wanted; without any, say how to come by one. */
function openFirst() {
  if (!jobs.isKnown) {
    isOpened = false;
    get("empty").hidden = true;
    return;
  }
  const isIdle = viewer.scene === null && awaited === null && !form.isSending && !waiting.isOn;
  if (!isOpened && isIdle && drawers.isOpen === null) {
    isOpened = true; // view() comes back here
    const newest = jobs.newest.map((id) => jobs.byId.get(id)).find(({ state }) => state === "done" || state === "running");
    if (newest) view(newest.id);
    else if (jobs.newest.length > 0) drawers.open("library", false);
  }
  isOpened = true;
  get("empty").hidden = !isIdle || viewer.scene !== null || jobs.byId.size > 0;
}

/** @param {{isOther?: boolean}} [report] isOther: it says or offers something else now */
function showJobs({ isOther = false } = {}) {
  if (isOther) reported = null;
  scopes.refresh();
  form.allow(scopes);
  sceneImport.allow(scopes);
  jobs.awaited = announcer.pending;
  announcer.refresh(jobs.byId, jobs.gone, awaited ?? viewer.scene);
  if (jobs.gone.has(awaited)) {
    awaited = null;
    waiting.end();
    if (!viewer.scene) viewer.open(null, words("page.deleted"));
  }
  offerMasks();
  shelf.refresh();
  list.show(shelf.shown, viewer.scene);
  compare.offer([...jobs.byId.values()]);
  setText(get("no-jobs"), shelf.nothing);
  const expected = jobs.byId.get(awaited);
  if (expected && expected.state !== "queued") view(expected.id);
  showProgress();
  openFirst();
  const viewed = jobs.byId.get(viewer.scene);
  viewer.screen.tellWork(workOn(viewed));
  light.keep(viewer.isRunning || viewed?.state === "running");
  get("scene-id").textContent = viewed ? nameOf(viewed) : "";
  if (viewed?.state === "done" && reported !== viewed.id) {
    if (viewer.shown?.state !== "done") viewer.refresh(); // what is shown may be of its training still
    report(viewed.id);
  }
  if (viewed && viewed.state !== "done") drawCurve(get("curve"), jobs.pointsOf(viewed.id), []);
}

function showConnection(text, kind) {
  if (kind === "good" && jobs.byId.has(viewer.scene)) viewer.screen.keepAlive();
  delete get("connection").dataset.words; // else a change of language says again that it connects
  get("connection").textContent = text;
  get("connection").className = `pill ${kind}`;
}

const list = new JobList(
  { list: get("jobs"), nothing: get("no-jobs"), message: get("jobs-message"), confirm: get("confirm") },
  scopes,
  {
    onView: view,
    onChange: () => jobs.poll(),
    onCalibrate: (id) => sendAgain(id, "calibration"),
    onRedraw: () => showJobs(),
    onLabelled: (job) => jobs.take(job),
    onDownload: (id, name) => downloads.open(id, name),
    summaryOf: (id) => shelf.summaryOf(id),
    onPurged: (id) => {
      if (viewer.scene === id) view(null, words("page.deleted"));
      jobs.forget(id);
    },
  },
);
const isWatched = () => drawers.isOpen === "library" || viewer.screen.trouble !== "" || viewer.isKeptWaiting;
const isHeard = () => viewer.shown?.state === "done" && viewer.pictures.stream.isOpen && viewer.screen.trouble === "";
export const jobs = new Jobs(showJobs, showConnection, isWatched, isHeard);
listOpenFeeds(get("open-feeds"), () => drawers.isOpen === "library");
const shelf = new Shelf({ search: get("search"), more: get("more-jobs"), message: get("jobs-message") }, jobs, showJobs);
const momentOf = (id) => {
  const t = viewer.scene === id ? viewer.timeline.t : 0;
  return { t, seconds: viewer.timeline.momentOf(t) };
};
const downloads = new Downloads(get("download"), get("jobs-message"), scopes, momentOf);

const light = new ScreenLight();
viewer.timeline.playEvents.addEventListener("changed", () => {
  light.keep(viewer.isRunning || jobs.byId.get(viewer.scene)?.state === "running");
  address.note();
});
const goTo = (place) => {
  if (place.scene !== viewer.scene) view(place.scene);
  viewer.look(place);
  compare.restore(place.compare);
  measure.restore(place.measures);
  setMoving(viewer, place);
};
const address = new Address(viewer, get("layer"), goTo, tell, () => ({ compare: compare.text, measures: measure.texts }));

const announcer = new Announcer({ line: get("sent"), ask: get("notify") }, view);
const form = new ClipForm(
  {
    form: get("upload"),
    again: get("upload-again"),
    message: get("upload-message"),
    progress: get("upload-progress"),
    stop: get("upload-stop"),
    refusal: get("upload-refusal"),
  },
  {
    onJob: expect,
    onSend: send,
    onShare(share) {
      announcer.send(share);
      if (share !== null) waiting.tell(shareOfSending(share), words("upload.sending", { share: figure(100 * share) }));
      else if (waiting.job === null) waiting.end(); // nothing came of it
    },
    onAsked: () => drawers.open("drawer", false),
    onScene: (file) => sceneImport.send(file),
  },
);
const sceneImport = new SceneImport({ ask: get("import"), file: get("import-file"), message: get("jobs-message") }, expect);
awaited = announcer.awaited; // of before a reload
if (awaited) viewer.open(null, words("page.awaited"));
get("empty-clip").addEventListener("click", () => drawers.open("drawer"));
get("empty-example").addEventListener("click", () => form.sendExample(words("empty.name")));
get("layer").addEventListener("change", offerMasks);
get("better-masks").addEventListener("click", () => sendAgain(viewer.scene));
showKeyForm({ form: get("key"), message: get("key-message"), forget: get("forget-key") });
languageEvents.addEventListener("changed", () => {
  jobs.poll();
  list.forget();
  showJobs({ isOther: true });
});
showWords(document);
keyEvents.addEventListener("changed", () => {
  view(null, words(currentKey() ? "page.choose" : "page.key_forgotten")); // another key may not see the same
  if (currentKey()) if (!address.follow() && location.hash) drawers.open("library", false); // it names no scene, and says so
});
prepareBanners(get("news"));
get("upload").addEventListener("submit", () => closeBanner(get("jobs-message")));
fitPicture(get("theatre"), get("stage"));
const isInUse = () => measure.isOn || (get("way").open && get("way").checkVisibility()) || document.querySelector("dialog[open]") !== null;
stepBackWhileIdle(get("theatre"), () => viewer.scene !== null && drawers.isOpen === null && !isInUse());
const showHelp = () => toggleHelp(get("help"));
const toggleFullScreen = prepareFullScreen(get("full-screen"));
prepareHelp(get("help"));
prepareLanguages(document.querySelectorAll("[data-language]"));
prepareFive(document);
prepareControlSets(document.querySelectorAll("[data-switch-controls]"));
get("show-help").addEventListener("click", showHelp);
const share = new Share(get("sharing"), scopes, {
  link: (isMoving) => address.link({ plays: isMoving, rocks: isMoving && compare.mayTurn }),
  scene: () => viewer.scene,
});
get("share").addEventListener("click", () => share.open());
onKeys("full_screen", { f: [] }, toggleFullScreen);
onKeys("copy_link", { l: [] }, () => address.copy());
onKeys("compare", { c: [] }, () => viewer.scene && compare.cycle());
onKeys("measure", { m: [] }, () => viewer.scene && measure.toggle());
onKeys("snapshot", { p: [] }, () => snapshot.take());
onKeys("close_drawer", { Escape: [] }, () => drawers.close());
onKeys("help", { "?": [] }, showHelp);
listenToKeys();
if (!address.follow() && location.hash) drawers.open("library", false); // it names no scene, and says so
