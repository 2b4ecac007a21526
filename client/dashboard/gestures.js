// Mouse, touch, pen and keys on the picture, as turns and approaches.

const KEY_STEP_PIXELS = 20;
const KEY_ZOOM = 1.1;
const WHEEL_PIXELS = 800;

const TURNS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const ZOOMS = { "+": KEY_ZOOM, "=": KEY_ZOOM, "-": 1 / KEY_ZOOM };

const distance = ([a, b]) => Math.hypot(a.x - b.x, a.y - b.y);

/**
 * @param {HTMLElement} stage
 * @param {{turn: (dx: number, dy: number) => void, approach: (factor: number) => void,
 *   home: () => void, play: () => void}} told
 */
export function listenToGestures(stage, { turn, approach, home, play }) {
  /** @type {Map<number, {x: number, y: number}>} fingers, or the mouse, by pointer id */
  const pointers = new Map();
  const at = (event) => ({ x: event.clientX, y: event.clientY });

  stage.addEventListener("pointerdown", (event) => {
    stage.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, at(event));
  });
  stage.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const apart = pointers.size === 2 ? distance([...pointers.values()]) : 0;
    pointers.set(event.pointerId, at(event));
    if (pointers.size === 1) turn(event.clientX - before.x, event.clientY - before.y);
    else if (apart > 0) approach(distance([...pointers.values()]) / apart);
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
    stage.addEventListener(end, (event) => pointers.delete(event.pointerId));
  }
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    approach(Math.exp(-event.deltaY / WHEEL_PIXELS));
  }, { passive: false });
  stage.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const [dx, dy] = TURNS[event.key] ?? [0, 0];
    if (dx || dy) turn(dx * KEY_STEP_PIXELS, dy * KEY_STEP_PIXELS);
    else if (ZOOMS[event.key]) approach(ZOOMS[event.key]);
    else if (event.key === "Home") home();
    else if (event.key === " ") play();
    else return;
    event.preventDefault();
  });
}
