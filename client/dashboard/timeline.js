// The clip's time: a slider, and playing it in a loop.

const LOOP_S = 5;

export class Timeline {
  /**
   * @param {{time: HTMLInputElement, timeValue: HTMLElement, play: HTMLButtonElement}} parts
   * @param {() => void} onChange
   * @param {() => boolean} isBusy whether another picture would only have to wait
   */
  constructor({ time, timeValue, play }, onChange, isBusy) {
    Object.assign(this, { time, timeValue, playButton: play, onChange, isBusy });
    this.t = 0;
    this.isPlaying = false;
    time.addEventListener("input", () => {
      this.play(false);
      this.set(Number(time.value));
    });
    play.addEventListener("click", () => this.play(!this.isPlaying));
  }

  /** @param {number} t from 0, the first frame, to 1, the end */
  set(t) {
    this.t = t;
    this.time.value = String(t);
    this.timeValue.textContent = `t ${t.toFixed(3)}`;
    this.onChange();
  }

  /** @param {boolean} isPlaying */
  play(isPlaying) {
    this.isPlaying = isPlaying;
    this.playButton.textContent = isPlaying ? "Pause" : "Play";
    this.playButton.setAttribute("aria-pressed", String(isPlaying));
    if (isPlaying) this.#run();
  }

  #run() {
    let last = performance.now();
    const run = (this.run = {}); // a second start ends the first
    const step = (now) => {
      if (!this.isPlaying || this.run !== run) return;
      if (!this.isBusy()) {
        const elapsed = Math.max(0, now - last) / 1000 / LOOP_S;
        last = now;
        this.set((this.t + elapsed) % 1);
      }
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }
}
