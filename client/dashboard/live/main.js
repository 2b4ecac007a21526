// The live screen: the endoscope's picture beside the model of it, one word on top, the past below, five actions.

import { closeBanner } from "../base/banners.js";
import { clockTime, setText } from "../base/element.js";
import { prepareFullScreen, ScreenLight } from "../base/fullscreen.js";
import { listenToGestures } from "../base/gestures.js";
import { prepareLanguages } from "../base/help.js";
import { keyEvents, showKeyForm } from "../base/key.js";
import { listenToKeys, onKeys } from "../base/keys.js";
import { figure, language, languageEvents, noticeWords, showWords, words } from "../base/messages.js";
import { Scopes } from "../base/scopes.js";
import { lightMark, trustOf } from "../library/trustlight.js";
import { placeInPicture } from "../measure/pointer.js";
import { prepareControlSets } from "../stage/controlsets.js";
import { Aloud } from "./aloud.js";
import { FeedClock } from "./clock.js";
import { endFeed, FeedEvents, pauseFeed, resumeFeed } from "./feeds.js";
import { BEHIND_S, headlineOf, headlineOfPicture, HIDDEN_STATES } from "./headline.js";
import { Health } from "./health.js";
import { Keeping } from "./keeping.js";
import { LIVE, Look } from "./look.js";
import { LiveMeasure } from "./measuring.js";
import { ModelPicture } from "./model.js";
import { Opening } from "./opening.js";
import { LivePicture } from "./picture.js";
import { feedHashOf, feedPlaceOf } from "./place.js";
import { Push } from "./push.js";
import { Tape } from "./tape.js";

const TICK_MS = 50;
const TAPE_MS = 250;
const WRITE_AFTER_MS = 400;
const STEP_S = 1;
const TURN = 20;
const NEARER = 1.1;
const ICONS = {
  live: "M12 4a8 8 0 1 0 .01 0z",
  behind: "M12 2 23 21H1z",
  frozen: "M12 2a10 10 0 1 0 .01 0zm0 2.4a7.6 7.6 0 1 1-.01 0zM10.8 6.5h2.4v4.7h5v2.4h-7.4z",
  back: "M11 4v5h11v6H11v5L1 12z",
  lost: "M4 1l8 8 8-8 3 3-8 8 8 8-3 3-8-8-8 8-3-3 8-8-8-8z",
  paused: "M4 2h6v20H4zM14 2h6v20h-6z",
  empty: "M12 2a10 10 0 1 0 .01 0zm0 3a7 7 0 1 1-.01 0z",
  connecting: "M2 10h5v5H2zM10 10h5v5h-5zM18 10h5v5h-5z",
  ended: "M3 3h18v18H3z",
};

const get = (id) => document.getElementById(id);

export const clock = new FeedClock();
export const picture = new LivePicture(get("live-picture"), clock);
export const model = new ModelPicture(get("model-picture"), clock);
export const look = new Look(model, clock);
const tape = new Tape({ slider: get("tape"), svg: get("tape-drawing"), ticks: get("tape-ticks") }, look, clock);
const health = new Health({ summary: get("health-summary"), list: get("health-list"), why: get("why") });
const aloud = new Aloud(get("word-aloud"));
const scopes = new Scopes(() => allow());
const light = new ScreenLight();
const keeping = new Keeping({ button: get("keep"), line: get("kept") }, clock, (fromS, toS) => {
  tape.mark({ atS: toS, fromS, kind: "kept" });
});
const over = { stage: get("model-stage"), canvas: get("model-picture"), over: get("model-over") };
export const measuring = new LiveMeasure({ ...over, told: get("measured"), button: get("measure") }, look, model);

/** @type {import("./feeds.js").Feed | null} as it was reported last */
let feed = null;
/** @type {string | null} */
let feedId = null;
let isGone = false;
/** @type {FeedEvents | null} */
let events = null;
/** @type {Push | null} */
let push = null;
let answeredMs = performance.now();
/** @type {Error | null} why the model shows nothing new */
let refused = null;

const opening = new Opening(
  {
    section: get("opening"),
    form: get("open-feed"),
    list: get("feeds"),
    none: get("no-feeds"),
    unknown: get("unknown-feed"),
    message: get("open-message"),
  },
  (id, media) => {
    push?.end();
    if (media) push = new Push(id, media, () => (push = null));
    location.hash = `#/${id}`;
  },
);

/**
 * Show a feed.
 * @param {string | null} id null: the list of those that are open
 * @param {boolean} [isUnknown] the address names none of them
 */
function view(id, isUnknown = false) {
  events?.stop();
  if (push && push.feedId !== id) push.end();
  [feedId, feed, isGone, refused] = [id, null, false, null];
  answeredMs = performance.now();
  clock.forget();
  tape.forget();
  keeping.forget();
  closeBanner(get("message"));
  look.open(id);
  picture.open(id);
  events = id && new FeedEvents(id, take, end);
  opening.show(id === null, isUnknown);
  get("screen").hidden = id === null;
  document.body.dataset.kind = "";
  light.keep(id !== null);
  tellHealth();
  refresh();
}

/** What the feed says of itself. @param {import("./feeds.js").Feed} told */
function take(told) {
  answeredMs = performance.now();
  if (feed?.label !== told.label) document.title = [told.label, "intrasplat"].filter(Boolean).join(" · ");
  feed = told;
  picture.allow(!HIDDEN_STATES.includes(told.state));
  if (told.begins_s === null) model.clear();
  allow();
  tellHealth();
  refresh();
}

function end() {
  if (feed === null) return view(null, true); // it never said anything
  isGone = true;
  feed = null;
  picture.open(null);
  look.open(null);
  model.clear();
  tellHealth();
  refresh();
}

/** All of it but the model's age. */
const tellHealth = () => health.refresh(feed, push?.pace.rate ?? NaN, picture.capturedAtS);

/** What the key may do. */
function allow() {
  opening.allow(scopes);
  for (const name of ["pause", "end"]) get(name).hidden = !scopes.has("feeds");
  get("keep").hidden = !scopes.has("feeds") || !scopes.has("reconstruct");
  const isPaused = feed?.state === "paused" || feed?.wish === "pause";
  get("pause").dataset.words = isPaused ? "live.resume" : "live.pause";
  setText(get("pause"), words(isPaused ? "live.resume" : "live.pause"));
}

/** @returns {number | null} s; null: the model follows nothing, or shows what was looked at before until its first picture */
function modelAge() {
  const { shown } = model;
  if (shown === null || look.mode !== "live") return null;
  const isBefore = shown.asked.t !== LIVE && performance.now() - look.liveMs < 1000 * BEHIND_S;
  return isBefore ? null : Math.max(0, clock.nowS - shown.capturedAtS);
}

/** @returns {import("./headline.js").Known} */
function known() {
  return {
    feed,
    isGone,
    mode: look.mode,
    answerAgeS: document.hidden ? 0 : (performance.now() - answeredMs) / 1000,
    pictureAtS: picture.capturedAtS,
    pictureAgeS: picture.ageS,
    pictureProblem: picture.problem,
    modelAgeS: modelAge(),
    frozenAt: clockTime(1000 * (model.shown?.capturedAtS ?? look.atS)), // the service may show a moment beside it
    backS: look.behindS,
  };
}

const ageWords = (ageS) =>
  ageS < 1 ? words("live.age_ms", { ms: figure(10 * Math.round(100 * ageS)) }) : words("live.age_s", { s: figure(ageS, 1) });

/** Everything that time alone changes. */
function refresh() {
  if (feedId === null) return;
  const now = known();
  const [top, ofPicture] = [headlineOf(now), headlineOfPicture(now)];
  const text = words(top.place, top.values);
  setText(get("word"), text);
  if (document.body.dataset.kind !== top.kind) {
    document.body.dataset.kind = top.kind;
    get("icon").firstElementChild.setAttribute("d", ICONS[top.kind]);
  }
  aloud.note(top, text);
  get("live-pane").dataset.kind = ofPicture.kind;
  get("live-icon").firstElementChild.setAttribute("d", ICONS[ofPicture.kind]);
  setText(get("live-word"), words(ofPicture.place, ofPicture.values));
  setText(get("live-age"), now.pictureAgeS === null ? "" : ageWords(now.pictureAgeS));
  setText(get("live-message"), picture.isBlank ? blankWords(ofPicture) : "");
  refreshModel(now);
  health.tellAge(now.modelAgeS ?? NaN); // the age beside the model, and no other
  const isAway = look.mode !== "live" || look.isTurned || look.rock.isOn;
  get("live").classList.toggle("wanted", isAway);
  get("freeze").setAttribute("aria-pressed", String(look.mode === "frozen"));
  get("look").setAttribute("aria-pressed", String(look.rock.isOn));
  for (const name of ["freeze", "measure", "look"]) get(name).disabled = model.shown === null;
  if (isGone) for (const name of ["keep", "live", "pause", "end"]) get(name).disabled = true;
}

function blankWords({ kind }) {
  if (kind === "empty") return words("live.nothing_recorded");
  if (kind === "ended") return words("live.ended_note");
  return picture.problem && feed?.begins_s != null ? picture.problem.message : "";
}

function refreshModel({ modelAgeS }) {
  const { shown } = model;
  const isLive = look.mode === "live";
  const age = shown === null ? "" : modelAgeS !== null
    ? words("live.model_behind", { s: figure(modelAgeS, 1) })
    : words("live.model_at", { time: clockTime(1000 * shown.capturedAtS) });
  setText(get("model-age"), age);
  get("model-pane").dataset.kind = isLive ? "live" : look.mode;
  setText(get("model-place"), look.rock.isOn ? words("live.rocking") : look.orbit.words);
  const message = shown === null && !isGone ? words(feed?.begins_s == null ? "live.no_model" : "live.model_loads") : "";
  setText(get("model-message"), refused ? refusalWords() : message);
  get("model-message").classList.toggle("over-picture", shown !== null);
}

function refusalWords() {
  if (refused.document?.field !== "t" || feed?.begins_s == null) return refused.message;
  const [from, to] = [feed.begins_s, feed.ends_s].map((atS) => clockTime(1000 * atS));
  return words("live.moment_gone", { from, to });
}

/** How far the view in sight can be trusted, with the worst reason, and what else the service notes of it. */
function showTrust() {
  const { shown } = model;
  const target = get("trust");
  const trust = shown && trustOf({ scored: true, psnr_tissue_db: 0, warnings: shown.warnings });
  const notices = trust ? [...trust.reasons.slice(0, 1), ...shown.warnings.filter(({ severity }) => severity === "info")] : [];
  const key = trust && JSON.stringify([language(), trust.light, notices.map(({ code }) => code)]);
  if (target.dataset.of === key) return;
  target.dataset.of = key ?? "";
  target.replaceChildren(...(trust ? [lightMark(trust.light)] : []));
  setText(get("trust-why"), notices.map(noticeWords).join(" "));
}

function showFault(text) {
  get("message").classList.add("bad");
  setText(get("message"), text);
}

async function act(button, work) {
  button.disabled = true;
  closeBanner(get("message"));
  try {
    const told = await work();
    if (told?.state && told.id === feedId) take(told);
  } catch (error) {
    showFault(error.message);
  }
  button.disabled = false;
}

function freeze() {
  if (look.mode === "frozen") return look.goLive();
  if (look.freeze()) tape.mark({ atS: look.atS, kind: "frozen" });
}

function askToEnd() {
  if (feed === null) return;
  const dialog = get("confirm");
  const pastS = Math.max(0, clock.nowS - (feed.begins_s ?? clock.nowS));
  const about = { min: figure(pastS / 60, 1), mb: figure(feed.stored_bytes / 1e6, 1) };
  setText(get("confirm-question"), words("live.end_question", about));
  dialog.showModal();
}

let writing = 0;
/** Say soon in the address what is looked at: browsers refuse to have it written often. */
function noteAddress() {
  writing ||= setTimeout(() => {
    writing = 0;
    const hash = feedId === null ? location.hash : feedHashOf(feedId, look.mode === "frozen" ? look.atS : null);
    if (hash !== location.hash) history.replaceState(null, "", hash);
  }, WRITE_AFTER_MS);
}

const keep = () => feed && !get("keep").hidden && keeping.keep(feed);
const isShown = () => feedId !== null;

picture.addEventListener("answered", () => (answeredMs = performance.now()));
model.addEventListener("answered", () => (answeredMs = performance.now()));
model.addEventListener("shown", () => {
  refused = null;
  showTrust();
  refresh(); // a new picture never stands beside the age of the one before
});
picture.addEventListener("shown", refresh);
model.addEventListener("refused", ({ detail }) => (refused = detail));
look.addEventListener("changed", () => {
  refused = null;
  refresh();
  noteAddress();
});
setInterval(refresh, TICK_MS);
setInterval(() => {
  if (feedId === null || document.hidden) return;
  tape.refresh(feed);
  tellHealth();
  if (model.shown === null) showTrust();
}, TAPE_MS);

get("freeze").addEventListener("click", freeze);
get("look").addEventListener("click", () => look.rock.toggle());
get("measure").addEventListener("click", () => measuring.toggle());
get("keep").addEventListener("click", keep);
get("live").addEventListener("click", () => look.goLive());
get("pause").addEventListener("click", () =>
  act(get("pause"), () => (feed?.state === "paused" || feed?.wish === "pause" ? resumeFeed : pauseFeed)(feedId)));
get("end").addEventListener("click", askToEnd);
get("confirm").addEventListener("click", ({ target }) => {
  if (target.value === undefined) return;
  get("confirm").close();
  if (target.value === "yes") act(get("end"), () => endFeed(feedId));
});
listenToGestures(get("model-stage"), {
  turn: (dx, dy) => look.turn((orbit) => orbit.turn(dx, dy)),
  pan: (dx, dy) => look.turn((orbit) => orbit.turn(dx, dy)),
  approach: (factor) => look.turn((orbit) => orbit.approach(factor)),
  focus: (x, y) => {
    const { camera } = model.shown ?? {};
    if (camera && placeInPicture(get("model-picture"), camera, x, y).isInside) look.turn((orbit) => orbit.goHome());
  },
});

const arrows = { ArrowLeft: [-STEP_S], ArrowRight: [STEP_S] };
onKeys("live_freeze", { " ": [], PageDown: [] }, () => isShown() && freeze());
onKeys("live_live", { l: [], PageUp: [], Home: [] }, () => isShown() && look.goLive());
onKeys("live_keep", { k: [] }, () => isShown() && keep());
onKeys("live_measure", { m: [] }, () => isShown() && measuring.toggle());
onKeys("live_rock", { r: [] }, () => isShown() && look.rock.toggle());
onKeys("live_step", arrows, (byS) => isShown() && look.step(byS));
onKeys("turn", { ArrowLeft: [TURN, 0], ArrowRight: [-TURN, 0], ArrowUp: [0, TURN], ArrowDown: [0, -TURN] },
  (dx, dy) => look.turn((orbit) => orbit.turn(dx, dy)), true);
onKeys("approach", { "+": [NEARER], "=": [NEARER], "-": [1 / NEARER] },
  (factor) => look.turn((orbit) => orbit.approach(factor)));
onKeys("full_screen", { f: [] }, prepareFullScreen(get("full-screen")));
prepareControlSets(document.querySelectorAll("[data-switch-controls]"));
listenToKeys();

const wide = matchMedia("(min-width: 1200px) and (min-height: 640px)");
const openHealth = () => (get("health").open = wide.matches);
wide.addEventListener("change", openHealth);
openHealth();
prepareLanguages(document.querySelectorAll("[data-language]"));
languageEvents.addEventListener("changed", () => {
  get("trust").dataset.of = "";
  showTrust();
  allow();
  refresh();
});
showKeyForm({ form: get("key"), message: get("key-message"), forget: get("forget-key") });
keyEvents.addEventListener("changed", () => follow());
showWords(document);

/** Show what the address names. */
function follow() {
  const { id, isNone, atS, isWrong } = feedPlaceOf(location.hash);
  view(id, isNone);
  if (isWrong) showFault(words("live.at_unreadable"));
  if (id === null || atS === null) return;
  tape.mark({ atS, kind: "frozen" });
  look.freezeAt(atS);
}
addEventListener("hashchange", follow);
addEventListener("pagehide", () => push?.end());
follow();
