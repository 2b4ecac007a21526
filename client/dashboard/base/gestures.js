// Mouse, touch and pen on the picture.

const WHEEL_PIXELS = 800;
const MAX_WHEEL = 240;

/** What each gesture does: the names of listenToGestures' acts, and of the help's words. */
export const GESTURES = {
  drag: "turn",
  shift_drag: "pan",
  two_fingers: "pan",
  wheel: "approach",
  pinch: "approach",
  double_click: "focus",
};

const distance = ([a, b]) => Math.hypot(a.x - b.x, a.y - b.y);
const middle = ([a, b]) => ({ x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 });

/**
 * @param {HTMLElement} stage
 * @param {{turn: (dx: number, dy: number) => void, pan: (dx: number, dy: number) => void,
 *   approach: (factor: number) => void, focus: (x: number, y: number) => void}} acts in CSS pixels; focus: of the window
 */
export function listenToGestures(stage, acts) {
  /** @type {Map<number, {x: number, y: number}>} fingers, or the mouse, by pointer id */
  const pointers = new Map();
  const act = (gesture, ...given) => acts[GESTURES[gesture]](...given);
  let drag = "drag";

  stage.addEventListener("pointerdown", (event) => {
    stage.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    drag = event.button === 0 && !event.shiftKey ? "drag" : "shift_drag";
  });
  stage.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return;
    const before = [...pointers.values()];
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const now = [...pointers.values()];
    if (now.length === 1) return act(drag, now[0].x - before[0].x, now[0].y - before[0].y);
    if (now.length > 2) return;
    if (distance(before) > 0) act("pinch", distance(now) / distance(before));
    act("two_fingers", middle(now).x - middle(before).x, middle(now).y - middle(before).y);
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
    stage.addEventListener(end, (event) => pointers.delete(event.pointerId));
  }
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1);
    act("wheel", Math.exp(-Math.max(-MAX_WHEEL, Math.min(MAX_WHEEL, pixels)) / WHEEL_PIXELS));
  }, { passive: false });
  stage.addEventListener("dblclick", (event) => act("double_click", event.clientX, event.clientY));
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
}
