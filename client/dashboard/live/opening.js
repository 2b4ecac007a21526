// The list of open feeds, and the form that opens another: from an address, a file, or a capture device of this browser.

import { setText } from "../base/element.js";
import { languageEvents, words } from "../base/messages.js";
import { translatePickers } from "../base/pickers.js";
import { showProblem } from "../base/problem.js";
import { listFeeds, openFeed } from "./feeds.js";
import { showFeeds } from "./links.js";
import { canCapture, openCapture } from "./push.js";
import { EXAMPLES, faultOf } from "./sources.js";

const LOOK_MS = 2000;

export class Opening {
  /**
   * @param {{section: HTMLElement, form: HTMLFormElement, list: HTMLElement, none: HTMLElement, unknown: HTMLElement,
   *   message: HTMLElement}} parts
   * @param {(id: string, media: MediaStream | null) => void} onOpen
   */
  constructor(parts, onOpen) {
    Object.assign(this, { parts, onOpen, timer: 0 });
    const { form } = parts;
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#open();
    });
    form.addEventListener("change", (event) => event.target.name === "from" && this.#offer());
    form.elements.source.addEventListener("change", () => this.#judge());
    form.elements.source.addEventListener("input", () => this.#say("")); // not while it is being typed
    languageEvents.addEventListener("changed", () => {
      this.#offer();
      if (!parts.section.hidden) this.#list();
    });
    translatePickers(form);
    form.elements.from.value = "url";
    for (const each of form.querySelectorAll("[value=capture]")) each.disabled = !canCapture();
    parts.form.querySelector(".no-capture").hidden = canCapture();
    this.#offer();
  }

  /** @param {boolean} isShown @param {boolean} isUnknown the address names no open feed */
  show(isShown, isUnknown) {
    this.parts.section.hidden = !isShown;
    this.parts.unknown.hidden = !isUnknown;
    clearInterval(this.timer);
    if (!isShown) return;
    this.#list();
    this.timer = setInterval(() => this.#list(), LOOK_MS);
  }

  /** @param {import("../base/scopes.js").Scopes} scopes */
  allow(scopes) {
    this.parts.form.hidden = !scopes.has("feeds");
  }

  #offer() {
    const { form } = this.parts;
    const from = form.elements.from.value;
    const { source, device } = form.elements;
    const isTyped = from !== "capture";
    source.closest("label").hidden = !isTyped;
    source.required = isTyped;
    if (isTyped) {
      setText(form.querySelector("#source-name"), words(`live.source_${from}`));
      source.placeholder = EXAMPLES[from];
      setText(form.querySelector("#source-note"), words(`live.source_note_${from}`));
    }
    this.#judge();
    device.closest("label").hidden = isTyped || device.options.length < 2;
    if (!isTyped) this.#listDevices();
  }

  /** Say what is to be changed in the source. @returns {boolean} whether it can be sent */
  #judge() {
    const { source, from } = this.parts.form.elements;
    const text = source.value.trim();
    const fault = from.value === "capture" || text === "" ? "" : faultOf(from.value, text);
    this.#say(fault && words(fault));
    return fault === "";
  }

  #say(fault) {
    const { source } = this.parts.form.elements;
    setText(this.parts.form.querySelector("#source-fault"), fault);
    source.setAttribute("aria-invalid", String(fault !== ""));
  }

  /** Names are known once the user has allowed a device. */
  async #listDevices() {
    const { device, from } = this.parts.form.elements;
    const found = canCapture() ? await navigator.mediaDevices.enumerateDevices().catch(() => []) : [];
    const cameras = found.filter(({ kind, deviceId, label }) => kind === "videoinput" && deviceId && label);
    const known = [...device.options].map(({ value }) => value).join();
    if (cameras.map(({ deviceId }) => deviceId).join() !== known) {
      device.replaceChildren(...cameras.map(({ deviceId, label }) => new Option(label, deviceId)));
    }
    device.closest("label").hidden = from.value !== "capture" || device.options.length < 2;
  }

  async #list() {
    const { list, none } = this.parts;
    try {
      const feeds = await listFeeds();
      showFeeds(list, feeds);
      setText(none, feeds.length > 0 ? "" : words("live.none_open"));
    } catch (error) {
      setText(none, error.message);
    }
  }

  async #open() {
    const { form, message } = this.parts;
    const { source, device, calibration, layout, label } = form.elements;
    const isCapture = form.elements.from.value === "capture";
    const submit = form.querySelector("[type=submit]");
    let media = null;
    message.replaceChildren();
    message.classList.remove("bad");
    if (!this.#judge()) return source.focus();
    submit.disabled = true;
    try {
      if (isCapture) media = await openCapture(device.value).catch(() => null);
      if (isCapture && media === null) throw new Error(words("live.capture_refused"));
      const options = { layout: layout.value };
      if (label.value.trim()) options.label = label.value.trim();
      if (!isCapture) options.source = source.value.trim();
      const feed = await openFeed(options, calibration.files[0]);
      form.reset();
      this.#offer();
      this.onOpen(feed.id, media);
    } catch (error) {
      for (const track of media?.getTracks() ?? []) track.stop();
      showProblem(message, error);
    }
    submit.disabled = false;
  }
}
