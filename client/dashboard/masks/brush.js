// Correcting a scene's masks: its recorded frames with the mask coloured over them, and a brush. It is a screen of its own in
// front of the page, and loaded when it is opened first.

import { bodyOf, request } from "../base/api.js";
import { button, element } from "../base/element.js";
import { figure, words } from "../base/messages.js";
import { showProblem } from "../base/problem.js";
import { Paper } from "./paper.js";
import { PaintedMasks } from "./strokes.js";

const MIN_SIZE = 1;
const MAX_SIZE = 200;
/** Of the picture's width: the brush at first. */
const FIRST_SHARE = 1 / 32;
const SIZE_STEP = 1.25;

/** Load the styles of this screen. @returns {Promise<void>} */
export function styled() {
  const href = new URL("masks.css", import.meta.url).href;
  if ([...document.styleSheets].some((each) => each.href === href)) return Promise.resolve();
  return new Promise((resolve, reject) => {
    const link = Object.assign(document.createElement("link"), { rel: "stylesheet", href, onload: resolve, onerror: reject });
    document.head.append(link);
  });
}

/**
 * Open the screen, once it is styled.
 * @param {string} scene
 * @param {import("../base/wire.js").Report} report with recorded frames and their pixels
 * @param {() => boolean} isSending whether a clip is being sent, so that no other can be
 * @param {(masks: File) => void} onMasks the masks that are to be sent
 */
export function openBrush(scene, report, isSending, onMasks) {
  if (!document.querySelector("dialog.brush")) new Brush(scene, report, isSending, onMasks);
}

class Brush {
  constructor(scene, report, isSending, onMasks) {
    Object.assign(this, { scene, isSending, onMasks });
    this.masks = new PaintedMasks(scene, report);
    this.paper = new Paper(report.recorded.pixels, (stroke) => {
      this.masks.add(stroke);
      this.#tell();
    });
    this.frame = this.masks.storedFrames[0];
    this.chosen = { isTool: true, isForAll: false };
    this.size = Math.max(MIN_SIZE, Math.min(MAX_SIZE, Math.round(this.masks.width * FIRST_SHARE)));
    /** @type {Map<number, Promise<Blob>>} */
    this.pictures = new Map();
    this.looks = 0; // counts frames that were asked for: only the newest is shown
    this.isClosed = this.isMaking = false;
    this.#build();
    this.dialog.showModal();
    this.paper.stage.focus();
    this.#listen();
    this.#choose();
    this.#go(this.frame);
  }

  #build() {
    this.tool = button(words("brush.tool"), () => this.#choose({ isTool: true }));
    this.tissue = button(words("brush.tissue"), () => this.#choose({ isTool: false }));
    this.here = button(words("brush.here"), () => this.#choose({ isForAll: false }));
    this.all = button(words("brush.all"), () => this.#choose({ isForAll: true }));
    this.slider = Object.assign(element("input"), { type: "range", min: MIN_SIZE, max: MAX_SIZE, ariaLabel: words("brush.size") });
    this.slider.addEventListener("input", () => this.#choose({ size: Number(this.slider.value) }));
    this.undoes = button(words("brush.undo"), () => this.#undo());
    this.sends = button(words("brush.send"), () => this.#send());
    this.sends.className = "sends";
    this.closes = button(words("page.close"), () => this.#leave());
    this.message = Object.assign(element("div", { class: "message" }), { role: "alert" });
    this.state = Object.assign(element("p", { class: "state" }), { role: "status" });
    this.strip = element("div", { class: "strip" }, ...this.masks.storedFrames.map((frame) => this.#thumbnail(frame)));
    Object.assign(this.strip, { role: "group", ariaLabel: words("brush.frames") });
    const title = Object.assign(element("h2", { text: words("brush.title") }), { id: "brush-title" });
    const group = (name, ...parts) => Object.assign(element("div", { class: "group" }, ...parts), { role: "group", ariaLabel: words(name) });
    const smaller = button("−", () => this.#resize(1 / SIZE_STEP), words("brush.smaller"));
    const larger = button("+", () => this.#resize(SIZE_STEP), words("brush.larger"));
    this.dialog = element(
      "dialog",
      { class: "brush" },
      element("header", {}, title, this.state, this.closes),
      this.paper.stage,
      this.message,
      element(
        "div",
        { class: "frames" },
        button("‹", () => this.#step(-1), words("brush.back")),
        this.strip,
        button("›", () => this.#step(1), words("brush.on")),
      ),
      element(
        "div",
        { class: "brushes" },
        group("brush.paints", this.tool, this.tissue),
        group("brush.size", smaller, this.slider, larger),
        group("brush.reach", this.here, this.all),
        this.undoes,
        this.sends,
      ),
      element("p", { class: "quiet keys", text: words("brush.keys") }),
    );
    this.dialog.setAttribute("aria-labelledby", title.id);
    document.body.append(this.dialog);
  }

  /** @param {number} frame @returns {HTMLButtonElement} whose picture is loaded when it comes into sight */
  #thumbnail(frame) {
    const made = button("", () => this.#go(frame));
    made.dataset.frame = String(frame);
    made.append(Object.assign(element("img"), { alt: "" }), element("span", { text: String(frame + 1) }));
    return made;
  }

  #listen() {
    this.seen = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) if (isIntersecting) this.#showThumbnail(target);
    }, { root: this.strip });
    for (const each of this.strip.children) this.seen.observe(each);
    this.dialog.addEventListener("keydown", (event) => this.#press(event));
    this.dialog.addEventListener("cancel", (event) => {
      event.preventDefault();
      this.#leave();
    });
    this.dialog.addEventListener("close", () => this.#end());
    this.warn = (event) => this.masks.strokes.length > 0 && event.preventDefault();
    window.addEventListener("beforeunload", this.warn);
  }

  #end() {
    this.isClosed = true;
    this.seen.disconnect();
    this.paper.close();
    window.removeEventListener("beforeunload", this.warn);
    for (const { src } of this.strip.querySelectorAll("img[src]")) URL.revokeObjectURL(src);
    this.dialog.remove();
  }

  /** Close it; strokes that were not sent are asked about. Not while masks are made of them. */
  #leave() {
    if (this.isMaking) return;
    if (this.masks.strokes.length === 0) return this.dialog.close();
    const question = Object.assign(element("p", { text: words("brush.ask") }), { id: "brush-question" });
    const stays = button(words("brush.stay"), () => ask.close());
    const discards = button(words("brush.discard"), () => {
      ask.close();
      this.masks.discard();
      this.dialog.close();
    });
    discards.value = "yes";
    const ask = element("dialog", { class: "leaving" }, question, element("div", { class: "actions" }, stays, discards));
    ask.setAttribute("aria-labelledby", question.id);
    ask.addEventListener("close", () => ask.remove());
    document.body.append(ask);
    ask.showModal();
  }

  #picture(frame) {
    if (!this.pictures.has(frame)) {
      const query = new URLSearchParams({ t: String(frame / this.masks.count), masks: "off" });
      const picture = request(`/scenes/${this.scene}/recorded?${query}`).then((response) => bodyOf(response, "blob"));
      picture.catch(() => this.pictures.delete(frame)); // asked for again with the next look at it
      this.pictures.set(frame, picture);
    }
    return this.pictures.get(frame);
  }

  async #showThumbnail(target) {
    const image = target.querySelector("img");
    if (image.src) return;
    const blob = await this.#picture(Number(target.dataset.frame)).catch(() => null); // the number stands there without it
    if (blob && !image.src && !this.isClosed) image.src = URL.createObjectURL(blob);
  }

  #step(by) {
    const { storedFrames: stored } = this.masks;
    this.#go(stored[Math.max(0, Math.min(stored.length - 1, stored.indexOf(this.frame) + by))]);
  }

  /** Look at a frame. @param {number} frame */
  async #go(frame) {
    const look = ++this.looks;
    this.frame = frame;
    this.paper.clear();
    delete this.dialog.dataset.shown;
    this.message.replaceChildren();
    this.#tell();
    const shown = this.strip.querySelector(`[data-frame="${frame}"]`);
    shown.scrollIntoView({ block: "nearest", inline: "center" });
    if (this.strip.contains(document.activeElement)) shown.focus();
    try {
      await this.masks.load();
      const [picture, mask] = await Promise.all([this.#picture(frame).then(createImageBitmap), this.masks.mask(frame)]);
      if (look === this.looks) {
        this.paper.show(frame, picture, mask);
        this.dialog.dataset.shown = String(frame);
      }
      picture.close();
    } catch (error) {
      if (look === this.looks) showProblem(this.message, error);
    }
  }

  async #undo() {
    if (this.paper.isPainting || this.isMaking) return;
    const undone = this.masks.undo();
    if (!undone) return;
    await this.#go(undone.isForAll ? this.frame : undone.frame);
  }

  /** @param {{isTool?: boolean, isForAll?: boolean, size?: number}} [chosen] */
  #choose({ size = this.size, ...chosen } = {}) {
    Object.assign(this.chosen, chosen);
    this.size = Math.max(MIN_SIZE, Math.min(MAX_SIZE, Math.round(size)));
    this.slider.value = String(this.size);
    this.slider.ariaValueText = words("brush.pixels", { count: figure(this.size) });
    const { isTool, isForAll } = this.chosen;
    for (const [each, isOn] of [[this.tool, isTool], [this.tissue, !isTool], [this.here, !isForAll], [this.all, isForAll]]) {
      each.setAttribute("aria-pressed", String(isOn));
    }
    this.paper.take({ ...this.chosen, size: this.size });
  }

  #resize(by) {
    const next = this.size * by;
    this.#choose({ size: by > 1 ? Math.max(this.size + 1, next) : Math.min(this.size - 1, next) });
  }

  /** Say which frame is in view, and mark those that were changed. */
  #tell() {
    const { storedFrames, strokes, count } = this.masks;
    for (const each of this.strip.children) {
      const frame = Number(each.dataset.frame);
      const isChanged = this.masks.isChanged(frame);
      each.toggleAttribute("data-changed", isChanged);
      each.tabIndex = frame === this.frame ? 0 : -1; // one stop on the way of the tab key
      each.setAttribute("aria-current", String(frame === this.frame));
      each.setAttribute("aria-label", words(isChanged ? "brush.frame_changed" : "brush.frame", { frame: frame + 1, count }));
    }
    const now = words(this.masks.isChanged(this.frame) ? "brush.frame_changed" : "brush.frame", { frame: this.frame + 1, count });
    const more = storedFrames.length < count ? `. ${words("brush.nearest")}` : "";
    this.state.textContent = now + more;
    this.undoes.disabled = this.sends.disabled = this.isMaking || strokes.length === 0;
    this.closes.disabled = this.isMaking;
  }

  /** @param {KeyboardEvent} event */
  #press(event) {
    const { key } = event;
    const acts = {
      ...this.paper.keys(event),
      b: () => this.#choose({ isTool: true }),
      e: () => this.#choose({ isTool: false }),
      "[": () => this.#resize(1 / SIZE_STEP),
      "]": () => this.#resize(SIZE_STEP),
      ",": () => this.#step(-1),
      ".": () => this.#step(1),
      Escape: () => this.#leave(),
    };
    const isUndo = (event.ctrlKey || event.metaKey) && key === "z";
    const isOther = event.metaKey || (event.ctrlKey && !event.getModifierState("AltGraph")); // some keyboards have [ there
    const act = isUndo ? () => this.#undo() : isOther ? null : acts[key];
    if (!act) return;
    event.preventDefault();
    if (!this.paper.isPainting && !this.isMaking) act();
  }

  async #send() {
    this.message.replaceChildren();
    if (this.isSending()) return this.message.append(element("p", { text: words("upload.one_at_a_time") }));
    this.isMaking = this.paper.isResting = true;
    this.#tell();
    try {
      const file = await this.masks.file((share) => (this.state.textContent = words("brush.making", { share: figure(100 * share) })));
      if (this.isClosed) return;
      this.dialog.close();
      this.onMasks(file);
    } catch (error) {
      this.isMaking = this.paper.isResting = false;
      this.#tell();
      showProblem(this.message, error);
    }
  }
}
