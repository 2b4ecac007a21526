// The list of open feeds, and the form that opens another: from an address, or from a capture device of this browser.

import { setText } from "../base/element.js";
import { languageEvents, words } from "../base/messages.js";
import { showProblem } from "../base/problem.js";
import { listFeeds, openFeed } from "./feeds.js";
import { showFeeds } from "./links.js";
import { canCapture, openCapture } from "./push.js";

const LOOK_MS = 2000;

export class Opening {
  /**
   * @param {{section: HTMLElement, form: HTMLFormElement, list: HTMLElement, none: HTMLElement, message: HTMLElement}} parts
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
    languageEvents.addEventListener("changed", () => !parts.section.hidden && this.#list());
    form.elements.from.value = "url";
    for (const each of form.querySelectorAll("[value=capture]")) each.disabled = !canCapture();
    parts.form.querySelector(".no-capture").hidden = canCapture();
    this.#offer();
  }

  /** @param {boolean} isShown */
  show(isShown) {
    this.parts.section.hidden = !isShown;
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
    const isUrl = this.parts.form.elements.from.value === "url";
    const { source, device } = this.parts.form.elements;
    source.closest("label").hidden = !isUrl;
    source.required = isUrl;
    device.closest("label").hidden = isUrl || device.options.length < 2;
    if (!isUrl) this.#listDevices();
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
    device.closest("label").hidden = from.value === "url" || device.options.length < 2;
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
    const { from, source, device, calibration, layout, label } = form.elements;
    const submit = form.querySelector("[type=submit]");
    let media = null;
    message.replaceChildren();
    message.classList.remove("bad");
    submit.disabled = true;
    try {
      if (from.value === "capture") media = await openCapture(device.value).catch(() => null);
      if (from.value === "capture" && media === null) throw new Error(words("live.capture_refused"));
      const options = { layout: layout.value };
      if (label.value.trim()) options.label = label.value.trim();
      if (from.value === "url") options.source = source.value.trim();
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
