// A file that shows one scene without a service: the player of the page, with a few controls. The scene lies in the file.

import { dateTime, element, setText } from "../base/element.js";
import { listenToGestures } from "../base/gestures.js";
import { figure, noticeWords, showWords, words } from "../base/messages.js";
import { likenessOf } from "../library/figures.js";
import { lightMark, trustOf } from "../library/trustlight.js";
import { Player } from "../player/player.js";
import { graphics } from "../player/support.js";
import { comparisonParts } from "../stage/seam.js";
import { Comparison } from "./comparison.js";
import { bytesOf, Recording } from "./recording.js";

const DEGREES_A_PIXEL = 0.15;
const KEY_PIXELS = 20;
const MAX_DEGREES = 60;
const [MIN_ZOOM, MAX_ZOOM] = [0.3, 4];
const KEY_ZOOM = 1.1;
/** A picture is drawn at most so much larger than the clip's. */
const MAX_ENLARGED = 2;
/** So long after the last movement the picture is drawn with exactly its own order. */
const REST_MS = 200;
const SAID_MS = 10_000;
const TURNS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const ZOOMS = { "+": KEY_ZOOM, "=": KEY_ZOOM, "-": 1 / KEY_ZOOM };

const get = (id) => document.getElementById(id);
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

/** What an element of the file holds; the element goes, with its memory. */
function taken(id) {
  const text = get(id).textContent;
  get(id).remove();
  return text;
}

/** @param {string} text below the picture, for a while */
function say(text) {
  get("message").textContent = text;
  setTimeout(() => get("message").textContent === text && setText(get("message"), ""), SAID_MS);
}

class View {
  /** @param {Player} player @param {Comparison | null} comparison null: there are no recorded frames */
  constructor(player, comparison) {
    this.player = player;
    this.comparison = comparison;
    this.cameras = player.cameras;
    this.last = (this.cameras.frameCount - 1) / this.cameras.frameCount;
    this.durationS = this.cameras.seconds(this.last);
    Object.assign(this, { t: 0, isPlaying: false, isWanted: false, isDrawing: false, rest: 0 });
    this.goHome();
  }

  goHome() {
    Object.assign(this, { isHome: true, yaw: 0, pitch: 0, zoom: 1 });
  }

  /** @param {boolean} isOn whether recording and model are parted by a seam */
  compare(isOn) {
    if (!this.comparison || this.comparison.isOn === isOn) return;
    this.comparison.choose(isOn);
    if (isOn) this.goHome();
  }

  turn(dx, dy) {
    this.isHome = false;
    this.yaw = clamp(this.yaw - dx * DEGREES_A_PIXEL, -MAX_DEGREES, MAX_DEGREES);
    this.pitch = clamp(this.pitch + dy * DEGREES_A_PIXEL, -MAX_DEGREES, MAX_DEGREES);
  }

  approach(factor) {
    this.isHome = false;
    this.zoom = clamp(this.zoom * factor, MIN_ZOOM, MAX_ZOOM);
  }

  /** Ask for a picture of what is wanted now; isMoving: another will follow. */
  show(isMoving = false) {
    if (this.comparison?.isOn && !this.isHome) {
      this.compare(false);
      say(words("compare.turned"));
    }
    clearTimeout(this.rest);
    if (isMoving) this.rest = setTimeout(() => this.show(), REST_MS);
    this.isMoving = isMoving;
    this.isWanted = true;
    get("time").value = String(this.t);
    const shown = [this.cameras.seconds(this.t), this.durationS].map((seconds) => figure(seconds, 2));
    get("seconds").textContent = words("file.seconds", { now: shown[0], all: shown[1] });
    get("time").setAttribute("aria-valuetext", get("seconds").textContent);
    if (!this.isDrawing) this.#draw();
  }

  async #draw() {
    this.isDrawing = true;
    try {
      while (this.isWanted) {
        this.isWanted = false;
        const { yaw, pitch, zoom } = this;
        const pose = this.isHome ? this.cameras.endoscope(this.t) : this.cameras.orbit(yaw, pitch, zoom);
        const view = { t: this.t, pose, ...this.#size(), isMarked: get("marked").checked, isMoving: this.isMoving };
        let [drawn] = await Promise.all([this.player.draw(view), this.#loadRecorded()]);
        this.comparison?.draw();
        setText(get("notices"), [...new Set(drawn.warnings.map(noticeWords))].join(" "));
        if (!this.isMoving) drawn = await this.#refined(view, drawn);
        get("picture").toggleAttribute("data-detail", drawn.hasDetail);
      }
    } catch (error) {
      refuse(error);
    } finally {
      this.isDrawing = false;
    }
  }

  async #loadRecorded() {
    try {
      await this.comparison?.load(this.t);
    } catch (error) {
      this.compare(false);
      say(words("compare.failed", { why: error.message }));
    }
  }

  /** Draw what rests with the detail of recorded frames, where there are any. */
  async #refined(view, drawn) {
    if (drawn.hasDetail || this.isWanted || this.player.detail === null) return drawn;
    const isOutdated = () => this.isWanted;
    try {
      return await this.player.draw({ ...view, isRefined: true, isOutdated });
    } catch (error) {
      if (!isOutdated()) say(words("compare.failed", { why: error.message })); // what is drawn stays
      return drawn;
    }
  }

  /** The picture's size in pixels: what fits into the stage, in the clip's shape. */
  #size() {
    const { width, height } = this.cameras.intrinsics;
    const { clientWidth, clientHeight } = get("stage");
    const fitting = Math.min(clientWidth / width, clientHeight / height);
    const { style } = get("fitted");
    style.width = `${Math.max(1, Math.floor(width * fitting))}px`;
    style.height = `${Math.max(1, Math.floor(height * fitting))}px`;
    return this.cameras.drawnSize(Math.min(fitting * devicePixelRatio, MAX_ENLARGED));
  }

  play(isPlaying) {
    this.isPlaying = isPlaying;
    get("play").textContent = words(isPlaying ? "file.pause" : "file.play");
    get("play").setAttribute("aria-pressed", String(isPlaying));
    let before = performance.now();
    const run = (this.run = {}); // a second start ends the first
    const step = (now) => {
      if (!this.isPlaying || this.run !== run) return;
      if (!this.isDrawing) {
        this.t = (this.t + (Math.max(0, now - before) / 1000 / Math.max(this.durationS, 0.1)) * this.last) % (this.last || 1);
        before = now;
        this.show(true);
      }
      requestAnimationFrame(step);
    };
    if (isPlaying) requestAnimationFrame(step);
  }

  /** The view that the address asks for, after #: t=0.5&orbit=10,0,1, or t=0.5&compare=wipe. */
  read(text) {
    const asked = new URLSearchParams(text.slice(1));
    const t = Number(asked.get("t") ?? NaN);
    if (Number.isFinite(t)) this.t = clamp(t, 0, this.last);
    this.compare(asked.get("compare") === "wipe");
    const [yaw, pitch, zoom] = (asked.get("orbit") ?? "").split(",").map(Number);
    if (![yaw, pitch, zoom].every(Number.isFinite)) return;
    this.isHome = false;
    [this.yaw, this.pitch] = [yaw, pitch].map((each) => clamp(each, -MAX_DEGREES, MAX_DEGREES));
    this.zoom = clamp(zoom, MIN_ZOOM, MAX_ZOOM);
  }
}

/** Say that the scene cannot be shown. */
function refuse(error) {
  document.body.dataset.state = "refused";
  get("message").textContent = words("file.refused", { why: error.message });
}

/** @param {string} name @param {string} text of one more fact */
function tellFact(name, text) {
  get("facts").append(element("dt", { text: words(`file.fact_${name}`) }), element("dd", { text }));
}

function describe({ sceneId, version, exportedAtMs, sceneBytes, recorded, report }, manifest) {
  const { width, height } = manifest.intrinsics;
  const facts = {
    scene: sceneId ?? "–",
    exported: `${dateTime(exportedAtMs)} · intrasplat ${version}`,
    preset: manifest.preset,
    frames: words("file.frames", { frames: manifest.frame_times_s.length, seconds: figure(manifest.frame_times_s.at(-1), 2), width, height }),
    gaussians: figure(manifest.gaussians),
    size: words("file.megabytes", { size: figure(sceneBytes / 1e6, 2) }),
    recorded: words(`file.recorded_${recorded.state}`, { size: figure(recorded.bytes / 1e6, 2) }),
  };
  for (const [name, text] of Object.entries(facts)) tellFact(name, text);
  if (report === null) return;
  get("verdict").append(lightMark(trustOf(report).light));
  const items = report.warnings.map((each) => element("li", { text: `${noticeWords(each)} ` }, element("small", { text: each.text })));
  get("warnings").append(...items);
}

/** @param {View} view */
function listen(view) {
  const moved = (act) => (...given) => {
    act(...given);
    view.show(true);
  };
  const [turn, approach, home] = [(dx, dy) => view.turn(dx, dy), (by) => view.approach(by), () => view.goHome()].map(moved);
  const play = () => view.play(!view.isPlaying);
  const compare = () => {
    view.compare(!view.comparison?.isOn);
    view.show();
  };
  const nothing = () => {};
  listenToGestures(get("stage"), { turn, approach, home, play, pan: nothing, focus: nothing });
  addEventListener("keydown", (event) => {
    const isElsewhere = ["INPUT", "BUTTON", "SUMMARY"].includes(event.target.tagName);
    if (event.defaultPrevented || isElsewhere || event.ctrlKey || event.metaKey || event.altKey) return;
    if (TURNS[event.key]) turn(...TURNS[event.key].map((each) => each * KEY_PIXELS));
    else if (ZOOMS[event.key]) approach(ZOOMS[event.key]);
    else if (event.key === "Home") home();
    else if (event.key === " ") play();
    else if (event.key === "c") compare();
    else return;
    event.preventDefault();
  });
  get("time").max = String(view.last);
  get("time").addEventListener("input", () => {
    view.play(false);
    view.t = Number(get("time").value);
    view.show(true);
  });
  get("play").addEventListener("click", play);
  get("home").addEventListener("click", home);
  get("compare").addEventListener("click", compare);
  get("marked").addEventListener("change", () => view.show());
  addEventListener("hashchange", () => {
    view.read(location.hash);
    view.show();
  });
  new ResizeObserver(() => view.show()).observe(get("stage"));
}

/** What shows the recorded frames beside the model. @param {Player} player @returns {Promise<Comparison | null>} null: it lacks frames */
async function comparisonFor(player) {
  const recording = new Recording(bytesOf(taken("video")), JSON.parse(taken("pictures")));
  try {
    await recording.open(player);
  } catch (error) {
    say(error.code === "no_codec" ? words("file.no_video") : words("compare.failed", { why: error.message }));
    return null; // the other frames are of other moments
  }
  if (recording.frames.length === 0) return null;
  const parts = { ...comparisonParts(get), button: get("compare"), tools: get("tools") };
  return new Comparison(parts, recording, player.hasRecordedLight);
}

async function start() {
  showWords(document);
  const manifest = JSON.parse(taken("manifest"));
  const about = JSON.parse(taken("about"));
  describe(about, manifest);
  const support = graphics();
  if (!support.isFast && support.name === "") throw new Error(words("file.no_webgl2"));
  get("message").textContent = words(support.isFast ? "file.opening" : "file.slow");
  const player = await Player.of({ manifest, scene: bytesOf(taken("scene")).buffer }, get("picture"));
  get("message").textContent = "";
  const comparison = await comparisonFor(player);
  tellFact("quality", about.report === null ? "–" : likenessOf(about.report, player.detail !== null));
  const view = new View(player, comparison);
  view.read(location.hash);
  listen(view);
  view.show();
  document.body.dataset.state = "shown";
}

start().catch(refuse);
