// The picture: time, orbit, layer. At most one request is under way; the newest wish is asked for next.

import { render } from "./api.js";

const DEGREES_A_PIXEL = 0.15;
const MOST_YAW = 60;
const MOST_PITCH = 60;
const LOOP_S = 5;

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

export class Viewer {
  constructor(parts) {
    this.parts = parts;
    this.scene = null;
    this.t = 0;
    this.layer = "rgb";
    this.goHome();
    this.playing = false;
    this.busy = false;
    this.wanted = false;
    this.listen();
  }

  open(scene) {
    this.scene = scene;
    this.goHome();
    this.parts.frame.hidden = true;
    this.parts.message.hidden = false;
    this.parts.message.textContent = scene ? "rendering" : "Choose a finished job.";
    this.refresh();
  }

  goHome() {
    this.orbit = null; // the endoscope's own pose
  }

  refresh() {
    this.wanted = true;
    if (!this.busy) this.work();
  }

  async work() {
    this.busy = true;
    while (this.wanted && this.scene) {
      this.wanted = false;
      await this.renderOnce(this.scene);
    }
    this.busy = false;
  }

  async renderOnce(scene) {
    const { stage, frame, message, warning, latency } = this.parts;
    const started = performance.now();
    try {
      const answer = await render(this.query(scene));
      if (scene !== this.scene || answer.scene !== this.scene) return; // never another patient's picture
      const url = URL.createObjectURL(answer.blob);
      const old = frame.src;
      frame.src = url;
      await frame.decode();
      if (old.startsWith("blob:")) URL.revokeObjectURL(old);
      frame.hidden = false;
      frame.alt = `${this.layer} at t ${this.t.toFixed(3)}`;
      stage.classList.remove("stale");
      message.hidden = true;
      warning.textContent = answer.warning.replaceAll(".; ", ". ");
      latency.textContent = `${Math.round(performance.now() - started)} ms`;
    } catch (error) {
      stage.classList.add("stale"); // a frozen frame must not look live
      message.hidden = false;
      message.textContent = `not live: ${error.message}`;
      await new Promise((resolve) => setTimeout(resolve, 1000));
      this.wanted = this.wanted || error.status === 503 || error.status === undefined;
    }
  }

  query(scene) {
    const query = { scene, t: this.t.toFixed(4), layer: this.layer, format: "jpeg" };
    if (this.orbit) {
      const { yaw, pitch, zoom } = this.orbit;
      query.pose = `orbit:${yaw.toFixed(2)},${pitch.toFixed(2)},${zoom.toFixed(3)}`;
    }
    return query;
  }

  turn(dx, dy, factor = 1) {
    if (!this.scene) return;
    const { yaw, pitch, zoom } = this.orbit ?? { yaw: 0, pitch: 0, zoom: 1 };
    this.orbit = {
      yaw: clamp(yaw - dx * DEGREES_A_PIXEL, -MOST_YAW, MOST_YAW),
      pitch: clamp(pitch + dy * DEGREES_A_PIXEL, -MOST_PITCH, MOST_PITCH),
      zoom: clamp(zoom * factor, 0.3, 4),
    };
    this.refresh();
  }

  setTime(t) {
    this.t = t;
    this.parts.time.value = String(t);
    this.parts.timeValue.textContent = `t ${t.toFixed(3)}`;
    this.refresh();
  }

  play(playing) {
    this.playing = playing;
    this.parts.play.textContent = playing ? "Pause" : "Play";
    this.parts.play.setAttribute("aria-pressed", String(playing));
    let last = performance.now();
    const step = (now) => {
      if (!this.playing) return;
      const elapsed = (now - last) / 1000 / LOOP_S;
      if (!this.busy) {
        last = now;
        this.setTime((this.t + elapsed) % 1);
      }
      requestAnimationFrame(step);
    };
    if (playing) requestAnimationFrame(step);
  }

  listen() {
    const { stage, time, layer, home, play } = this.parts;
    stage.addEventListener("pointerdown", (event) => stage.setPointerCapture(event.pointerId));
    stage.addEventListener("pointermove", (event) => {
      if (stage.hasPointerCapture(event.pointerId)) this.turn(event.movementX, event.movementY);
    });
    stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.turn(0, 0, Math.exp(-event.deltaY / 800));
    }, { passive: false });
    stage.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [20, 0], ArrowRight: [-20, 0], ArrowUp: [0, 20], ArrowDown: [0, -20] }[event.key];
      if (step) {
        event.preventDefault();
        this.turn(...step);
      }
    });
    time.addEventListener("input", () => {
      this.play(false);
      this.setTime(Number(time.value));
    });
    layer.addEventListener("change", () => {
      this.layer = layer.value;
      this.refresh();
    });
    home.addEventListener("click", () => {
      this.goHome();
      this.refresh();
    });
    play.addEventListener("click", () => this.play(!this.playing));
  }
}
