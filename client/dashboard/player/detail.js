// What a scene's model misses of its recorded training frames, carried to a view: as intrasplat/view/detail.py computes it,
// on the GPU. Lengths are in units. Symbols: H W pixels of the view, h w of a recorded picture.

import { inverse, times } from "./camera.js";
import {
  ABOVE_NOISE, ALIKE, BLUR_COLUMNS, BLUR_ROWS, CARRY, CELL_PX, COARSE, FADED, GATHER, GATHERED, INNER, MISSED, POWER,
  RESIDUAL, SUMMED, TOGETHER,
} from "./detailshaders.js";
import { fillTarget, linked, matrix, target, texture } from "./gpu.js";
import { RecordedLight } from "./recordedlight.js";
import { EVERYWHERE, ROW } from "./shaders.js";

const [SHARED_DEG, LONE_DEG, OWN] = [12, 6, 0.5];
const NEGLIGIBLE = 0.02;
const CACHED = 6;
/** Of intrasplat/view/confidence.py and intrasplat/splat/metrics.py. */
const RIGHT_COLOUR = 0.03;
const ROUNDING = 1e-6;
const LEAST_SQUARED_ANGLE = 1e-7;

const squaredRad = (degrees) => ((degrees * Math.PI) / 180) ** 2;
const mean = (values) => values.reduce((sum, each) => sum + each, 0) / values.length;

/** @typedef {import("./camera.js").Matrix} Matrix */
/** What a training frame's picture of one eye shows and the model misses. @typedef {{eye: number, frame: number}} Wanted */

/** Textures, and targets to draw into them, that go together. */
class Textures {
  constructor(gl) {
    Object.assign(this, { gl, all: [], targets: [] });
  }

  /** @param {[number, number, number]} kind internal format, format and type @returns {WebGLTexture} */
  add([internal, format, type], width, height, data = null) {
    const made = texture(this.gl, internal, width, height, format, type, data);
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

export class Detail {
  /**
   * @param {import("./draw.js").Drawing} drawing
   * @param {import("./camera.js").Cameras} cameras
   * @param {Record<string, any>} settings of the scene's manifest
   * @param {import("./trainingpictures.js").TrainingPictures} pictures
   */
  static async of(drawing, cameras, settings, pictures) {
    const light = new RecordedLight(cameras, settings);
    await light.open();
    return new Detail(drawing, cameras, settings, pictures, light);
  }

  /** Use Detail.of(). */
  constructor(drawing, cameras, settings, pictures, light) {
    const { gl } = drawing;
    Object.assign(this, { gl, drawing, cameras, pictures, light });
    this.motionError = settings.motion_error ?? 0;
    const trained = new Set(cameras.trainedFrames);
    this.frames = pictures.frames.filter((frame) => trained.has(frame));
    this.HALVES = [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT];
    this.FLOATS = [gl.RGBA32F, gl.RGBA, gl.FLOAT];
    this.NUMBER = [gl.R32F, gl.RED, gl.FLOAT];
    this.BYTE = [gl.R8, gl.RED, gl.UNSIGNED_BYTE];
    const fills = { MISSED, INNER, FADED, POWER, COARSE, BLUR_ROWS, BLUR_COLUMNS, CARRY, ALIKE, TOGETHER };
    this.programs = Object.fromEntries(Object.entries(fills).map(([name, each]) => [name, linked(gl, EVERYWHERE, each)]));
    this.programs.RESIDUAL = linked(gl, ABOVE_NOISE, RESIDUAL);
    this.programs.GATHER = linked(gl, GATHER, GATHERED);
    this.points = gl.createVertexArray();
    /** @type {Map<string, Record<string, any>>} the last ones used, by eye and frame */
    this.residuals = new Map();
    this.ofEye = null; // what a residual is computed with
    this.ofView = null;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  /** @param {number} eye @param {number} t @returns {Matrix} world_from_eye, mm */
  eyePose(eye, t) {
    return times(this.cameras.endoscope(t), this.pictures.eyes[eye].leftFromEye);
  }

  /** The training frames before and after a time, and their weights. @returns {{frame: number, weight: number}[]} */
  neighbours(t) {
    const { frames } = this;
    const place = t * this.cameras.frameCount;
    const found = frames.findIndex((frame) => frame > place + ROUNDING);
    const after = found < 0 ? frames.length : found;
    if (after === 0 || after === frames.length) {
      return frames.slice(Math.max(0, after - 1)).slice(0, 1).map((frame) => ({ frame, weight: 1 }));
    }
    const [before, behind] = [frames[after - 1], frames[after]];
    const share = Math.min(Math.max((place - before) / (behind - before), 0), 1);
    const known = this.#followed(t);
    const both = [{ frame: before, weight: known * (1 - share) }, { frame: behind, weight: known * share }];
    return both.filter(({ weight }) => weight > ROUNDING);
  }

  /** As intrasplat/view/confidence.py: how far the motion is followed at a time. */
  #followed(t) {
    const trained = this.cameras.trainedTimes;
    if (!this.motionError || trained.length < 2) return 1;
    const later = trained.findIndex((each) => each >= t);
    const after = Math.min(Math.max(later < 0 ? trained.length : later, 1), trained.length - 1);
    const [before, behind] = [trained[after - 1], trained[after]];
    const distance = Math.min(1, Math.min(Math.abs(t - before), Math.abs(t - behind)) / ((behind - before) / 2));
    const size = (distance * (2 - distance) * Math.sqrt(this.motionError)) / 255;
    return RIGHT_COLOUR / (RIGHT_COLOUR + size);
  }

  /** The residuals that a view may need. @param {number} t @param {Matrix} pose @returns {Wanted[]} */
  wanted(t, pose) {
    const poses = this.pictures.eyes.map((_, eye) => this.eyePose(eye, t));
    const own = poses.findIndex((each) => each.every((row, i) => row.every((value, j) => Math.abs(value - pose[i][j]) < 1e-9)));
    const eyes = own < 0 ? poses.map((_, eye) => eye) : [own];
    return this.neighbours(t).flatMap(({ frame }) => eyes.map((eye) => ({ eye, frame })));
  }

  /** Whether a residual is there; it stays, then, while others are computed. @param {Wanted} wanted */
  has({ eye, frame }) {
    const key = keyOf(eye, frame);
    const found = this.residuals.get(key);
    if (!found) return false;
    this.residuals.delete(key);
    this.residuals.set(key, found);
    return true;
  }

  /** Where the model's own picture of an eye is to be blended, before measure(). @returns {WebGLFramebuffer} */
  ownTarget(eye) {
    const { width, height } = this.pictures.eyes[eye].lens;
    if (this.ofEye?.width !== width || this.ofEye.height !== height) {
      this.ofEye?.made.free();
      const made = new Textures(this.gl);
      const [shown, known] = this.drawing.blendable(width, height, 2);
      made.all.push(shown, known);
      const [missed, faded] = [this.HALVES, this.HALVES].map((kind) => made.add(kind, width, height));
      const inner = made.add(this.BYTE, width, height);
      const sums = made.add(this.FLOATS, SUMMED, SUMMED);
      const [missedTarget, innerTarget, fadedTarget, sumTarget] = [missed, inner, faded, sums].map((each) => made.target(each));
      const targets = { missedTarget, innerTarget, fadedTarget, sumTarget, blendTarget: made.target(shown, known) };
      this.ofEye = { width, height, made, shown, known, missed, faded, inner, sums, ...targets };
    }
    return this.ofEye.blendTarget;
  }

  /**
   * Compute a residual: the model is deformed to its frame, and its picture is blended in ownTarget().
   * @param {Wanted} wanted
   * @param {import("./trainingpictures.js").Picture} picture
   */
  measure({ eye, frame }, picture) {
    const { gl, programs } = this;
    const { width, height, shown, known, missed, faded, inner, sums, ...targets } = this.ofEye;
    const { lens } = this.pictures.eyes[eye];
    const coded = new Textures(gl);
    const sizes = [[picture.width, picture.height], picture.chroma, picture.chroma];
    const [luma, blue, red] = picture.planes.map((plane, i) => coded.add(this.BYTE, ...sizes[i], plane));
    const mask = picture.mask && coded.add([gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE], width, height);
    if (mask) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, picture.mask);
    const smoke = this.light.smoke(gl, frame);
    if (smoke) coded.all.push(smoke);
    const pose = this.eyePose(eye, frame / this.cameras.frameCount);
    programs.MISSED.use({ shown, known, luma, blue, red, mask: mask ?? luma, smoke: smoke ?? luma }, {
      lens: fourOf(lens),
      isMasked: ["1i", mask ? 1 : 0],
      ...this.light.uniforms(frame, pose),
    });
    fillTarget(gl, targets.missedTarget, width, height);
    coded.free();
    programs.INNER.use({ missed }, {});
    fillTarget(gl, targets.innerTarget, width, height);
    programs.FADED.use({ missed, inner }, {});
    fillTarget(gl, targets.fadedTarget, width, height);
    programs.POWER.use({ faded }, {});
    fillTarget(gl, targets.sumTarget, SUMMED, SUMMED);
    const made = new Textures(gl);
    const [residual, depth] = [made.add(this.HALVES, width, height), made.add(this.NUMBER, width, height)];
    const centres = made.add(this.FLOATS, ROW, this.drawing.rows);
    programs.RESIDUAL.use({ sums, faded, known }, {});
    fillTarget(gl, made.target(residual, depth), width, height);
    this.#copyCentres(made.target(centres));
    this.residuals.set(keyOf(eye, frame), { made, residual, depth, centres, lens, pose });
    for (const [key, each] of this.residuals) {
      if (this.residuals.size <= CACHED) break;
      each.made.free();
      this.residuals.delete(key);
    }
  }

  #copyCentres(into) {
    const { gl, drawing } = this;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, drawing.stateTarget);
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, into);
    gl.blitFramebuffer(0, 0, ROW, drawing.rows, 0, 0, ROW, drawing.rows, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  /**
   * What the view that is blended gets; its residuals are there.
   * @param {number} t
   * @param {Matrix} pose
   * @param {import("./camera.js").Intrinsics} lens
   * @returns {WebGLTexture | null} red, green and blue [H, W]; null: nothing
   */
  add(t, pose, lens) {
    const { gl, programs } = this;
    const view = this.#sized(lens.width, lens.height);
    const { eyes, nearest, isOwn, weights } = this.#weights(t, pose, lens, this.#coarseDepth(view));
    const neighbours = this.neighbours(t);
    if (eyes.length === 0 || neighbours.length === 0) return null;
    const [before, after = before] = neighbours.map(({ frame }) => frame);
    const [, known] = this.drawing.blended;
    const cameraFromWorld = this.cameras.cameraFromWorld(pose);
    const moved = this.#motion(view, lens, cameraFromWorld, [before, after].map((frame) => this.residuals.get(keyOf(nearest, frame)).centres));
    const totals = eyes.map((eye, place) => {
      const [first, second] = [before, after].map((frame) => this.residuals.get(keyOf(eye, frame)));
      const fromView = (each) => matrix(this.cameras.inUnits(times(inverse(each.pose), pose)));
      const textures = { residualBefore: first.residual, depthBefore: first.depth, movedBefore: moved[0] };
      programs.CARRY.use({ known, ...textures, residualAfter: second.residual, depthAfter: second.depth, movedAfter: moved[1] }, {
        lens: fourOf(lens),
        eyeLens: fourOf(first.lens),
        beforeFromView: fromView(first),
        afterFromView: fromView(second),
        beforeFromWorld: matrix(this.cameras.cameraFromWorld(first.pose)),
        afterFromWorld: matrix(this.cameras.cameraFromWorld(second.pose)),
        weights: ["2f", neighbours[0].weight, neighbours[1]?.weight ?? 0],
      });
      fillTarget(gl, view.totalTargets[place], lens.width, lens.height);
      return view.totals[place];
    });
    const [left, right = left] = totals;
    if (totals.length === 2) {
      programs.ALIKE.use({ left, right }, {});
      fillTarget(gl, view.sumTarget, lens.width, lens.height);
    }
    gl.bindTexture(gl.TEXTURE_2D, view.weights);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ...view.cells, gl.RGBA, gl.FLOAT, weights);
    programs.TOGETHER.use({ left, right, sums: view.sums, weights: view.weights }, { eyes: ["1i", isOwn ? 0 : totals.length] });
    fillTarget(gl, view.addedTarget, lens.width, lens.height);
    return view.added;
  }

  /** Textures for views of a size. */
  #sized(width, height) {
    if (this.ofView?.width === width && this.ofView.height === height) return this.ofView;
    this.ofView?.made.free();
    const { gl } = this;
    const made = new Textures(gl);
    const cells = [width, height].map((side) => Math.ceil(side / CELL_PX));
    const many = (count, kind, size) => Array.from({ length: count }, () => made.add(kind, ...size));
    const gathered = this.drawing.blendable(...cells, 2);
    made.all.push(...gathered);
    const [blurred, moved] = [many(4, this.FLOATS, cells), many(2, this.FLOATS, cells)];
    const [sums, totals] = [made.add(this.FLOATS, width, height), many(2, this.HALVES, [width, height])];
    const [depths, weights, added] = [made.add(this.FLOATS, ...cells), made.add(this.FLOATS, ...cells), made.add(this.HALVES, width, height)];
    this.ofView = {
      width, height, made, cells, gathered, blurred, moved, sums, totals, weights, added,
      depthTarget: made.target(depths),
      gatherTarget: made.target(...gathered),
      blurTarget: made.target(...blurred),
      movedTarget: made.target(...moved),
      sumTarget: made.target(sums),
      addedTarget: made.target(added),
      totalTargets: totals.map((each) => made.target(each)),
    };
    return this.ofView;
  }

  /** @returns {Float32Array} in the middles of the view's cells, first row first; 0 where nothing is solid */
  #coarseDepth({ cells: [w, h], depthTarget }) {
    const { gl } = this;
    this.programs.COARSE.use({ known: this.drawing.blended[1] }, {});
    fillTarget(gl, depthTarget, w, h);
    const read = new Float32Array(4 * w * h);
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.FLOAT, read);
    return Float32Array.from({ length: w * h }, (_, at) => read[4 * at]);
  }

  /** Which eyes count at all, the nearest of them, and how much of what each alone misses, and of what both miss. */
  #weights(t, pose, lens, depth) {
    const poses = this.pictures.eyes.map((_, eye) => this.eyePose(eye, t));
    const [w] = this.ofView.cells;
    const solid = depth.filter((each) => each > 0).sort();
    const [low, high] = [solid[(solid.length - 1) >> 1] ?? 1, solid[solid.length >> 1] ?? 1];
    const far = (low + high) / 2;
    const points = Array.from(depth, (each, at) => {
      const cell = [at % w, Math.floor(at / w)];
      const [j, i] = [lens.width, lens.height].map((side, axis) => Math.min(CELL_PX * cell[axis] + CELL_PX / 2, side - 1) + 0.5);
      const d = each > 0 ? each : far;
      return [(d * (j - lens.cx)) / lens.fx, (d * (i - lens.cy)) / lens.fy, d, 1];
    });
    const angles = poses.map((each) => this.#squaredAngles(points, pose, each, pose));
    const lone = squaredRad(LONE_DEG);
    const apart = poses.length === 1 ? null : this.#squaredAngles(points, pose, poses[0], poses[1]);
    const between = (at) => Math.max(apart === null ? lone : OWN ** 2 * apart[at], LEAST_SQUARED_ANGLE);
    const own = angles.map((each) => each.map((angle, at) => Math.exp(angle / (-2 * between(at)))));
    const shared = points.map((_, at) => Math.exp(Math.min(...angles.map((each) => each[at])) / (-2 * squaredRad(SHARED_DEG))));
    const means = own.map(mean);
    const nearest = means.indexOf(Math.max(...means));
    const isOwn = own[nearest].every((each) => each > 1 - NEGLIGIBLE);
    const all = shared.some((each) => each > NEGLIGIBLE) ? poses.map((_, eye) => eye) : [];
    const weights = new Float32Array(4 * points.length);
    points.forEach((_, at) => weights.set([own[0][at], own.at(-1)[at], shared[at]], 4 * at));
    return { eyes: isOwn ? [nearest] : all, nearest, isOwn, weights };
  }

  /** Squared angles, radians, at points of a view between the rays to an eye and to another place. */
  #squaredAngles(points, pose, eye, other) {
    const rows = this.cameras.inUnits(times(inverse(eye), pose));
    const place = this.cameras.inUnits(times(inverse(eye), other)).map((row) => row[3]);
    return points.map((point) => {
      const there = rows.map((row) => row.reduce((sum, each, i) => sum + each * point[i], 0));
      const [a, b] = [there, there.map((each, i) => each - place[i])];
      const product = a.reduce((sum, each, i) => sum + each * b[i], 0);
      return Math.max(0, 2 - (2 * product) / Math.max(Math.hypot(...a) * Math.hypot(...b), ROUNDING));
    });
  }

  /** The motion to two frames in the view's cells. @returns {WebGLTexture[]} */
  #motion(view, lens, cameraFromWorld, [before, after]) {
    const { gl, programs, drawing } = this;
    programs.GATHER.use({ now: drawing.states[0], before, after, known: drawing.blended[1] }, {
      cameraFromWorld: matrix(cameraFromWorld),
      lens: fourOf(lens),
      cells: ["2i", ...view.cells],
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, view.gatherTarget);
    gl.viewport(0, 0, ...view.cells);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.bindVertexArray(this.points);
    gl.drawArrays(gl.POINTS, 0, drawing.count);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
    programs.BLUR_ROWS.use({ before: view.gathered[0], after: view.gathered[1] }, {});
    fillTarget(gl, view.blurTarget, ...view.cells);
    const [nearBefore, nearAfter, farBefore, farAfter] = view.blurred;
    programs.BLUR_COLUMNS.use({ nearBefore, nearAfter, farBefore, farAfter }, {});
    fillTarget(gl, view.movedTarget, ...view.cells);
    return view.moved;
  }

  /** Let go of the recorded pictures; the GPU's memory goes with the drawing's. */
  close() {
    this.pictures.close();
  }
}

const keyOf = (eye, frame) => `${eye} ${frame}`;
const fourOf = ({ fx, fy, cx, cy }) => ["4f", fx, fy, cx, cy];
