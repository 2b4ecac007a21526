// What the model shows: which moment of the feed, from where. It follows the endoscope until somebody freezes it, looks
// back, or turns it.

import { Orbit } from "../stage/orbit.js";
import { Rock } from "../stage/rock.js";
import { isoOf } from "./place.js";

const TICK_MS = 50;
/** So long without a hand, a view that was turned goes back to the endoscope's. */
export const RETURN_AFTER_MS = 20_000;
/** Less than this behind the newest moment is live. */
const LIVE_S = 0.5;
/** The newest moment, as the service calls it. */
export const LIVE = "live";
const HANDS = ["pointermove", "pointerdown", "wheel", "keydown"];

/** Tells "changed" when another moment or place is looked at, or a mode is. */
export class Look extends EventTarget {
  /** @param {import("./model.js").ModelPicture} model @param {import("./clock.js").FeedClock} clock */
  constructor(model, clock) {
    super();
    Object.assign(this, { model, clock, feedId: null, handMs: performance.now() });
    this.orbit = new Orbit(() => 0);
    this.rock = new Rock(this.orbit, () => this.#ask(), () => this.#changed());
    this.#beLive();
    setInterval(() => this.#tick(), TICK_MS);
    for (const sign of HANDS) {
      document.addEventListener(sign, () => (this.handMs = performance.now()), { capture: true, passive: true });
    }
  }

  #beLive() {
    /** @type {"live"|"frozen"|"back"} back: some seconds behind, at the pace of the feed */
    this.mode = "live";
    /** @type {number} UNIX time, s, of the frozen moment */
    this.atS = 0;
    this.backS = 0;
    /** @type {number} since when it is live, by this browser's steady clock */
    this.liveMs = performance.now();
  }

  /** @param {string | null} feedId */
  open(feedId) {
    this.feedId = feedId;
    this.rock.stop();
    this.orbit.goHome();
    this.#beLive();
    this.model.clear();
    this.#changed();
  }

  /** Everything back: the newest moment, from the endoscope. */
  goLive() {
    this.rock.stop();
    this.orbit.goHome();
    this.#beLive();
    this.#changed();
  }

  /** Stay at the moment in view. @returns {boolean} false: there is none */
  freeze() {
    const { shown } = this.model;
    if (this.mode === "frozen") return true;
    if (shown === null) return false;
    this.freezeAt(shown.capturedAtS);
    return true;
  }

  /** Stay at a moment. @param {number} atS UNIX time */
  freezeAt(atS) {
    [this.mode, this.atS] = ["frozen", atS];
    this.#changed();
  }

  /** @param {number} backS seconds behind the newest moment */
  lookBack(backS) {
    if (backS < LIVE_S) this.#beLive();
    else [this.mode, this.backS] = ["back", backS];
    this.#changed();
  }

  /** Earlier or later by some seconds. @param {number} byS */
  step(byS) {
    if (this.mode !== "frozen") return this.lookBack(this.behindS - byS);
    this.atS = Math.min(this.atS + byS, this.clock.nowS);
    this.#changed();
  }

  /** @returns {number} seconds from the moment in view until now */
  get behindS() {
    if (this.mode === "live") return 0;
    return this.mode === "back" ? this.backS : Math.max(0, this.clock.nowS - this.atS);
  }

  /** @param {(orbit: Orbit) => void} work by a hand */
  turn(work) {
    if (this.feedId === null) return;
    this.rock.stop();
    work(this.orbit);
    this.#changed();
  }

  get isTurned() {
    return this.orbit.pose !== null;
  }

  #tick() {
    if (this.feedId === null) return;
    if (!this.rock.isOn && this.isTurned && performance.now() - this.handMs > RETURN_AFTER_MS) {
      this.orbit.goHome();
      return this.#changed();
    }
    if (this.mode === "back") this.#ask();
  }

  #changed() {
    this.#ask();
    this.dispatchEvent(new Event("changed"));
  }

  #ask() {
    if (this.feedId === null) return this.model.want(null);
    const { pose } = this.orbit;
    const wish = { scene: this.feedId, t: this.#t };
    if (pose !== null) wish.pose = pose;
    if (this.mode === "live" && !this.rock.isOn) wish.follow = true;
    this.model.want(wish);
  }

  get #t() {
    if (this.mode === "live") return LIVE;
    return isoOf(this.mode === "frozen" ? this.atS : this.clock.nowS - this.backS);
  }
}
