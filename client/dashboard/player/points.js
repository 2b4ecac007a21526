// The points that a view shows, on the GPU: how they move, and what they looked like at other times
// (intrasplat/view/residual.py). Lengths are in units. Symbols: H W pixels of the view, m n cells of it.

import { inverse, times } from "./camera.js";
import { CELL_PX } from "./flow.js";
import { fillTarget, matrix, target, texture } from "./gpu.js";

/** Internal format, format and type of textures. */
export const kindsOf = (gl) => ({
  halves: [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT],
  floats: [gl.RGBA32F, gl.RGBA, gl.FLOAT],
  two: [gl.RG32F, gl.RG, gl.FLOAT],
  number: [gl.R32F, gl.RED, gl.FLOAT],
  byte: [gl.R8, gl.RED, gl.UNSIGNED_BYTE],
  bytes: [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE],
});

export const fourOf = ({ fx, fy, cx, cy }) => ["4f", fx, fy, cx, cy];

/** Textures, and targets to draw into them, that go together. */
export class Textures {
  constructor(gl) {
    Object.assign(this, { gl, all: [], targets: [] });
  }

  /** @param {[number, number, number]} kind of kindsOf() @returns {WebGLTexture} */
  add([internal, format, type], width, height, data = null) {
    return this.take(texture(this.gl, internal, width, height, format, type, data));
  }

  /** @param {WebGLTexture} made elsewhere */
  take(made) {
    this.all.push(made);
    return made;
  }

  target(...textures) {
    const made = target(this.gl, textures);
    this.targets.push(made);
    return made;
  }

  free() {
    for (const each of this.all) this.gl.deleteTexture(each);
    for (const each of this.targets) this.gl.deleteFramebuffer(each);
  }
}

/** A view at a time. known: what was blended of depth, or depth. @typedef {{pose: import("./camera.js").Matrix,
 *   lens: import("./camera.js").Intrinsics, known: WebGLTexture, centres: WebGLTexture}} View */

export class Points {
  /** @param {import("./draw.js").Drawing} drawing @param {import("./camera.js").Cameras} cameras for views of a size */
  constructor(drawing, cameras, programs, width, height) {
    const { gl } = drawing;
    Object.assign(this, { gl, drawing, cameras, programs, width, height });
    const { floats } = kindsOf(gl);
    const made = (this.made = new Textures(gl));
    const cells = (this.cells = [width, height].map((side) => Math.ceil(side / CELL_PX)));
    const many = (count) => Array.from({ length: count }, () => made.add(floats, ...cells));
    this.gathered = drawing.blendable(...cells, 2).map((each) => made.take(each));
    [this.blurred, this.moved, this.corrected] = [many(4), many(2), many(2)];
    [this.depths, this.weights] = many(2);
    const drawn = [this.gathered, this.blurred, this.moved, this.corrected].map((each) => made.target(...each));
    [this.gatherTarget, this.blurTarget, this.movedTarget, this.correctedTarget] = drawn;
    this.depthTarget = made.target(this.depths);
    this.array = gl.createVertexArray();
  }

  isOf({ width, height }) {
    return this.width === width && this.height === height;
  }

  /** Depth in the cells' middles, first row first; 0 where nothing is solid. @param {WebGLTexture} known */
  depthInCells(known) {
    const { gl } = this;
    const [w, h] = this.cells;
    this.programs.COARSE.use({ known }, {});
    fillTarget(gl, this.depthTarget, w, h);
    const read = new Float32Array(4 * w * h);
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.FLOAT, read);
    return Float32Array.from({ length: w * h }, (_, at) => read[4 * at]);
  }

  /** The motion in cells to two times of other centres. @param {View} view @returns {WebGLTexture[]} */
  motion({ pose, lens, known, centres }, [before, after]) {
    const { gl, programs } = this;
    programs.GATHER.use({ now: centres, before, after, known }, {
      cameraFromWorld: matrix(this.cameras.cameraFromWorld(pose)),
      lens: fourOf(lens),
      cells: ["2i", ...this.cells],
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.gatherTarget);
    gl.viewport(0, 0, ...this.cells);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.bindVertexArray(this.array);
    gl.drawArrays(gl.POINTS, 0, this.drawing.count);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
    programs.BLUR_ROWS.use({ before: this.gathered[0], after: this.gathered[1] }, {});
    fillTarget(gl, this.blurTarget, ...this.cells);
    const [nearBefore, nearAfter, farBefore, farAfter] = this.blurred;
    programs.BLUR_COLUMNS.use({ nearBefore, nearAfter, farBefore, farAfter }, {});
    fillTarget(gl, this.movedTarget, ...this.cells);
    return this.moved;
  }

  /** The motion to two frames of an eye, corrected by the flow between them. weights: of the frames. @returns {WebGLTexture[]} */
  correct({ pose, lens }, eyes, moved, flow, weights) {
    const [first] = eyes;
    this.programs.CORRECT.use({ movedBefore: moved[0], movedAfter: moved[1], weights: this.weights, flow }, {
      ...this.#seenFrom(pose, lens, eyes),
      size: ["2f", this.width, this.height],
      eyeSize: ["2f", first.lens.width, first.lens.height],
      share: ["1f", weights[1] / (weights[0] + weights[1])],
    });
    fillTarget(this.gl, this.correctedTarget, ...this.cells);
    return this.corrected;
  }

  /** What two frames of an eye show of the points, times weights. eyes: residual, depth, pose and lens of each. */
  carry({ pose, lens, known }, eyes, moved, weights, into) {
    const [first, second] = eyes;
    const before = { residualBefore: first.residual, depthBefore: first.depth, movedBefore: moved[0] };
    const after = { residualAfter: second.residual, depthAfter: second.depth, movedAfter: moved[1] };
    this.programs.CARRY.use({ known, ...before, ...after }, {
      ...this.#seenFrom(pose, lens, eyes),
      weights: ["2f", ...weights],
    });
    fillTarget(this.gl, into, this.width, this.height);
  }

  #seenFrom(pose, lens, [first, second]) {
    const fromView = (eye) => matrix(this.cameras.inUnits(times(inverse(eye.pose), pose)));
    return {
      lens: fourOf(lens),
      eyeLens: fourOf(first.lens),
      beforeFromView: fromView(first),
      afterFromView: fromView(second),
      beforeFromWorld: matrix(this.cameras.cameraFromWorld(first.pose)),
      afterFromWorld: matrix(this.cameras.cameraFromWorld(second.pose)),
    };
  }
}
