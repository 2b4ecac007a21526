// The page's address: #/scene/ID?t=&pose=&layer=&range=&compare=&m= names a view, what it is compared with and its measurements,
// so that it survives a reload and can be sent to others. play=1 and rock=1 let it play and rock as it opens.
// #/live/ID leads to the live screen of a feed.

import { addressOf } from "../live/links.js";
import { measurementOf } from "../measure/measurements.js";
import { words } from "./messages.js";
import { comparisonOf } from "./spelling.js";

/**
 * pose: as GET /render spells it, or RIGHT_EYE of spelling.js. range: of depth's false colours in mm; null: the clip's. compare: as text of
 * stage/compare.js; null: with nothing. measures: as textOf() of measure/measurements.js writes them. plays, rocks: as it opens.
 * @typedef {{scene: string, t: number, pose: string | null, layer: string, range: [number, number] | null,
 *   compare: string | null, measures: string[], plays?: boolean, rocks?: boolean}} Place
 */

const SCENE = /^#\/scene\/([^/?]*)(?:\?(.*))?$/;
const LIVE = /^#\/live(?:\/(.*))?$/;
const ID = /^[0-9a-f]{32}$/;
const POSE = /^(right|orbit:[-\d.e]+(,[-\d.e]+){2}((,[-\d.e]+){3})?|[-\d.e]+(,[-\d.e]+){11})$/;
const RANGE = /^([1-9]\d{0,3}),([1-9]\d{0,3})$/;
const WRITE_AFTER_MS = 400;
const TOLD_MS = 6000;

/**
 * @param {string} hash of an address
 * @param {string[]} layers there are
 * @returns {{place: Place | null, wrong: string}} wrong: what cannot be read, in words; the rest of the place stands
 */
export function placeOf(hash, layers) {
  if (hash === "" || hash === "#" || hash === "#/") return { place: null, wrong: "" };
  const found = SCENE.exec(hash);
  if (!found) return { place: null, wrong: words("address.unknown") };
  if (!ID.test(found[1])) return { place: null, wrong: words("address.scene") };
  const query = new URLSearchParams(found[2] ?? "");
  const wrong = [];
  const read = (name, isGood, otherwise) => {
    const text = query.get(name);
    if (text === null || isGood(text)) return text ?? otherwise;
    wrong.push(words(`address.${name}`));
    return otherwise;
  };
  const t = Number(read("t", (text) => text.trim() !== "" && Number(text) >= 0 && Number(text) <= 1, "0"));
  const pose = read("pose", (text) => POSE.test(text), null);
  const layer = read("layer", (text) => layers.includes(text), layers[0]);
  const range = read("range", isRange, null)?.split(",").map(Number) ?? null;
  const compare = read("compare", comparisonOf, null);
  const asked = query.getAll("m");
  const measures = asked.filter((text) => measurementOf(text) !== null);
  if (measures.length < asked.length) wrong.push(words("address.measures"));
  const [plays, rocks] = ["play", "rock"].map((name) => query.get(name) === "1");
  return { place: { scene: found[1], t, pose, layer, range, compare, measures, plays, rocks }, wrong: wrong.join(" ") };
}

/** @param {string} text */
function isRange(text) {
  const [, near, far] = RANGE.exec(text) ?? [];
  return Number(near) < Number(far);
}

/** @param {Place} place @param {string} usual the layer that needs no name @returns {string} the hash */
export function hashOf({ scene, t, pose, layer, range, compare, measures, plays, rocks }, usual) {
  const parts = [];
  if (t > 0) parts.push(`t=${Number(t.toFixed(4))}`);
  if (pose !== null) parts.push(`pose=${pose.trim().replace(/[,\s]+/g, ",")}`);
  if (layer !== usual) parts.push(`layer=${layer}`);
  if (range) parts.push(`range=${range.join(",")}`);
  if (compare) parts.push(`compare=${compare}`);
  if (plays) parts.push("play=1");
  if (rocks) parts.push("rock=1");
  parts.push(...measures.map((each) => `m=${encodeURIComponent(each).replaceAll("%2C", ",").replaceAll("%3B", ";").replaceAll("%3A", ":")}`));
  return `#/scene/${scene}${parts.length ? `?${parts.join("&")}` : ""}`;
}

/** Keeps the address true while the view changes. */
export class Address {
  /**
   * @param {import("../stage/viewer.js").Viewer} viewer
   * @param {HTMLSelectElement} layer
   * @param {(place: Place) => void} go there: somebody followed or typed an address
   * @param {(text: string, isBad?: boolean) => void} tell
   * @param {() => {compare: string | null, measures: string[]}} shown beside the view
   */
  constructor(viewer, layer, go, tell, shown) {
    Object.assign(this, { viewer, layer, go, tell, shown });
    this.timer = 0;
    addEventListener("hashchange", () => this.follow());
    viewer.addEventListener("shown", () => this.note());
    viewer.addEventListener("refused", () => tell(words("address.pose")));
  }

  get #layers() {
    return [...this.layer.options].map((each) => each.value);
  }

  /** Go where the address says. @returns {boolean} whether it names a scene */
  follow() {
    const live = LIVE.exec(location.hash);
    if (live) location.replace(addressOf(live[1] ?? ""));
    if (live) return true;
    const { place, wrong } = placeOf(location.hash, this.#layers);
    this.tell("");
    if (place) this.go(place);
    if (wrong) this.tell(wrong);
    return place !== null;
  }

  /** Say soon where the page is: not at every frame, not while it plays, and not in the history. */
  note() {
    this.timer ||= setTimeout(() => {
      this.timer = 0;
      if (!this.viewer.isRunning) this.write();
    }, WRITE_AFTER_MS);
  }

  /** @param {{plays?: boolean, rocks?: boolean}} [moving] as it opens @returns {string} the hash of the view; empty without one */
  hash(moving = {}) {
    const { scene, timeline, orbit, range } = this.viewer;
    const place = { scene, t: timeline.t, pose: orbit.place, layer: this.layer.value, range, ...this.shown(), ...moving };
    return scene ? hashOf(place, this.#layers[0]) : "";
  }

  /** @param {{plays?: boolean, rocks?: boolean}} moving as it opens @returns {string} the address of the view */
  link(moving) {
    return location.href.replace(/#.*$/, "") + this.hash(moving);
  }

  /** Say it now. */
  write() {
    const hash = this.hash();
    if (hash !== location.hash) history.replaceState(null, "", hash || location.pathname);
  }

  /** Put the address where it can be pasted from, and say so. */
  async copy() {
    this.write();
    try {
      await navigator.clipboard.writeText(location.href);
      this.tell(words("address.copied"), false);
      setTimeout(() => this.tell(""), TOLD_MS);
    } catch {
      this.tell(words("address.copy_by_hand", { link: location.href }), false); // pages without HTTPS have no clipboard
    }
  }
}
