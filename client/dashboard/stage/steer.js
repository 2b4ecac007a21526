// Hands on the picture and keys, as what they do to camera and time.

import { listenToGestures } from "../base/gestures.js";
import { onKeys } from "../base/keys.js";
import { words } from "../base/messages.js";
import { depthAt, placeInPicture, worldPoint } from "../measure/pointer.js";

const TURN = 20;
const PAN = 40;
const NEARER = 1.1;
const arrows = (by) => ({ ArrowLeft: [by, 0], ArrowRight: [-by, 0], ArrowUp: [0, by], ArrowDown: [0, -by] });

/**
 * @param {import("./viewer.js").Viewer} viewer
 * @param {{stage: HTMLElement, canvas: HTMLCanvasElement, home: HTMLButtonElement, eye: HTMLSelectElement,
 *   rock: HTMLButtonElement, stepBack: HTMLButtonElement, stepOn: HTMLButtonElement}} parts
 * @param {(text: string) => void} tell what somebody asked for and cannot have
 */
export function steer(viewer, { stage, canvas, home, eye, rock, stepBack, stepOn }, tell) {
  const { orbit, timeline } = viewer;
  const change = (work) => (...given) => {
    if (!viewer.scene) return;
    work(...given);
    viewer.refresh();
  };
  const focus = async (x, y) => {
    const { shown } = viewer;
    if (!shown?.camera) return;
    const { u, v, isInside } = placeInPicture(canvas, shown.camera, x, y);
    if (!isInside) return;
    try {
      const depthMm = await depthAt(shown, u, v);
      if (viewer.scene !== shown.scene) return;
      if (Number.isNaN(depthMm)) return tell(words("view.nothing_there"));
      tell("");
      change(() => orbit.focus(worldPoint(shown.camera, u, v, depthMm)))();
    } catch (error) {
      tell(error.message);
    }
  };
  const focusMiddle = () => {
    const { left, top, width, height } = canvas.getBoundingClientRect();
    return focus(left + width / 2, top + height / 2);
  };
  const acts = {
    turn: change((dx, dy) => orbit.turn(dx, dy)),
    pan: change((dx, dy) => {
      if (!viewer.shown?.camera) return;
      const { scale } = placeInPicture(canvas, viewer.shown.camera, 0, 0);
      const toClip = orbit.cameras ? orbit.cameras.intrinsics.width / viewer.shown.camera.width : 1;
      orbit.pan((dx / scale) * toClip, (dy / scale) * toClip);
    }),
    approach: change((factor) => orbit.approach(factor)),
    focus,
  };
  const goHome = change(() => orbit.goHome());
  const swing = () => viewer.scene && viewer.rock.toggle();
  const swapEyes = change(() => orbit.hasRightEye && orbit.seeRight(!(orbit.isHome && orbit.isRight)));
  listenToGestures(stage, acts);
  viewer.addEventListener("known", () => (eye.hidden = !orbit.hasRightEye));
  viewer.addEventListener("shown", () => (eye.value = orbit.isHome && orbit.isRight ? "right" : "left"));
  home.addEventListener("click", goHome);
  rock.addEventListener("click", swing);
  timeline.playEvents.addEventListener("changed", () => rock.setAttribute("aria-pressed", String(viewer.rock.isOn)));
  eye.addEventListener("change", change(() => orbit.seeRight(eye.value === "right")));
  stepBack.addEventListener("click", () => timeline.step(-1));
  stepOn.addEventListener("click", () => timeline.step(1));

  onKeys("play", { " ": [], PageDown: [] }, () => viewer.shown && timeline.play(!timeline.isPlaying));
  onKeys("step", { ",": [-1], ".": [1] }, (frames) => timeline.step(frames));
  onKeys("speed", { "<": [-1], ">": [1] }, (steps) => timeline.changeSpeed(steps));
  onKeys("loop_start", { a: [] }, () => timeline.startLoop());
  onKeys("loop_end", { b: [] }, () => timeline.endLoop());
  onKeys("loop_all", { x: [] }, () => timeline.loopAll());
  onKeys("turn", arrows(TURN), acts.turn);
  onKeys("pan", arrows(PAN), acts.pan, true);
  onKeys("approach", { "+": [NEARER], "=": [NEARER], "-": [1 / NEARER] }, acts.approach);
  onKeys("focus", { o: [] }, focusMiddle);
  onKeys("home", { Home: [] }, goHome);
  onKeys("rock", { r: [], PageUp: [] }, swing);
  onKeys("eye", { e: [] }, swapEyes);
}
