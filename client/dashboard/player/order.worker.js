// Packs a decoded scene for the GPU, then sorts its Gaussians by depth, view after view.

import { Cameras } from "./camera.js";
import { patternsAt } from "./motion.js";
import { Sorter } from "./order.js";
import { pack, STATE } from "./pack.js";
import { blendedValues, OutOfView } from "./trust.js";

/** What the endoscope sees lies at least so far before it, mm. */
const LEAST_DEPTH_MM = 1e-6;

let sorter = null;
let values = null;
let outOfView = null;

function prepare({ table, manifest }) {
  const began = performance.now();
  const packed = pack(table);
  sorter = new Sorter(packed, table.patterns);
  const { state } = packed;
  values = blendedValues(Float32Array.from({ length: table.count }, (_, n) => state[n * STATE + 11]));
  const cameras = new Cameras(manifest);
  if (values !== null && cameras.moves) {
    const patternsOf = (frame) => patternsAt(table, frame / cameras.frameCount);
    outOfView = new OutOfView(cameras, (frame) => inView(cameras, frame, patternsOf(frame)));
  }
  const { coefficients, stride } = packed;
  const ms = performance.now() - began;
  postMessage({ state, coefficients, stride, values, ms }, [state.buffer, coefficients.buffer]);
}

/** [N] whether the centres lie within the endoscope's view at a frame. */
function inView(cameras, frame, patterns) {
  const { width, height, fx, fy, cx, cy } = cameras.intrinsics;
  const rows = cameras.cameraFromWorld(cameras.poses[frame]);
  const seen = new Uint8Array(sorter.isSolid.length);
  for (let n = 0; n < seen.length; n++) {
    const place = [0, 1, 2].map((c) => sorter.centre(n, patterns, c));
    const [x, y, z] = rows.map((row) => row[0] * place[0] + row[1] * place[1] + row[2] * place[2] + row[3]);
    const ahead = Math.max(z, LEAST_DEPTH_MM * cameras.unitsPerMm);
    const [column, line] = [(fx * x) / ahead + cx, (fy * y) / ahead + cy];
    seen[n] = z > 0 && column >= 0 && column < width && line >= 0 && line < height ? 1 : 0;
  }
  return seen;
}

function sort({ id, patterns, row, seconds }) {
  const began = performance.now();
  const order = sorter.sort(patterns, row);
  const faded = outOfView?.faded(values, seconds) ?? null;
  const buffers = faded ? [order.buffer, faded.buffer] : [order.buffer];
  postMessage({ id, order, values: faded, ms: performance.now() - began }, buffers);
}

addEventListener("message", ({ data }) => {
  try {
    if (data.table) prepare(data);
    else sort(data);
  } catch (error) {
    postMessage({ id: data.id, error: error.message });
  }
});
