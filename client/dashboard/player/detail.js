// What a scene's model misses of its recorded training frames, carried to a view: as intrasplat/view/detail.py computes it,
// on the GPU. Lengths are in units. Symbols: H W pixels of the view, h w of a recorded picture.

import { times } from "./camera.js";
import {
  ABOVE_NOISE, ALIKE, BLUR_COLUMNS, BLUR_ROWS, CARRY, COARSE, CORRECT, FADED, GATHER, GATHERED, INNER, MISSED, PAIR, POWER,
  RESIDUAL, SUMMED, TOGETHER, VALID_GREY,
} from "./detailshaders.js";
import { CannotDrawError, fillTarget, linked } from "./gpu.js";
import { fourOf, kindsOf, Points, Textures } from "./points.js";
import { RecordedLight } from "./recordedlight.js";
import { EVERYWHERE, ROW } from "./shaders.js";
import { TrainingPictures } from "./trainingpictures.js";
import { weightsOf } from "./viewweights.js";

const CACHED = 6;
/** Of intrasplat/view/confidence.py and intrasplat/splat/metrics.py. */
const RIGHT_COLOUR = 0.03;
const ROUNDING = 1e-6;

/** @typedef {import("./camera.js").Matrix} Matrix */
/** A training frame's picture of an eye. @typedef {{eye: number, frame: number}} Wanted */
/** Two training frames' pictures of an eye. @typedef {{eye: number, before: number, after: number}} Pair */

export class Detail {
  /**
   * @param {import("./player.js").Player} player
   * @param {import("./trainingpictures.js").Source} source
   * @returns {Promise<Detail>}
   * @throws as TrainingPictures.open()
   */
  static async of({ drawing, cameras, settings }, source) {
    const light = new RecordedLight(cameras, settings);
    const [pictures] = await Promise.all([TrainingPictures.open(source), light.open()]);
    return new Detail(drawing, cameras, settings, pictures, light);
  }

  /** Use Detail.of(). */
  constructor(drawing, cameras, settings, pictures, light) {
    const { gl } = drawing;
    Object.assign(this, { gl, drawing, cameras, pictures, light });
    this.motionError = settings.motion_error ?? 0;
    const trained = new Set(cameras.trainedFrames);
    this.frames = pictures.frames.filter((frame) => trained.has(frame));
    this.kinds = kindsOf(gl);
    const ofFrames = { MISSED, INNER, FADED, POWER, VALID_GREY, PAIR };
    const ofViews = { COARSE, BLUR_ROWS, BLUR_COLUMNS, CARRY, CORRECT, ALIKE, TOGETHER };
    const fills = Object.entries({ ...ofFrames, ...ofViews });
    this.programs = Object.fromEntries(fills.map(([name, each]) => [name, linked(gl, EVERYWHERE, each)]));
    this.programs.RESIDUAL = linked(gl, ABOVE_NOISE, RESIDUAL);
    this.programs.GATHER = linked(gl, GATHER, GATHERED);
    this.worker = new Worker(new URL("./flow.worker.js", import.meta.url), { type: "module" });
    this.residuals = new Recent((each) => each.made.free());
    this.flows = new Recent((each) => each.free());
    this.ofEye = null; // what residuals and flows are computed with
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

  /**
   * What a view may need.
   * @param {number} t
   * @param {Matrix} pose
   * @param {boolean} highlights as in add()
   * @returns {{residuals: Wanted[], flows: Pair[]}}
   */
  wanted(t, pose, highlights) {
    const poses = this.pictures.eyes.map((_, eye) => this.eyePose(eye, t));
    const isOf = (each) => each.every((row, i) => row.every((value, j) => Math.abs(value - pose[i][j]) < 1e-9));
    const own = highlights ? poses.findIndex(isOf) : -1;
    const eyes = own < 0 ? poses.map((_, eye) => eye) : [own];
    const frames = this.neighbours(t).map(({ frame }) => frame);
    return {
      residuals: frames.flatMap((frame) => eyes.map((eye) => ({ eye, frame }))),
      flows: frames.length === 2 ? eyes.map((eye) => ({ eye, before: frames[0], after: frames[1] })) : [],
    };
  }

  /** Whether a residual is there; it stays, then, while others are computed. @param {Wanted} wanted */
  has({ eye, frame }) {
    return this.residuals.get(keyOf(eye, frame)) !== undefined;
  }

  /** Where the model's own picture of an eye is to be blended, before measure(). @returns {WebGLFramebuffer} */
  ownTarget(eye) {
    const { lens } = this.pictures.eyes[eye];
    if (this.ofEye?.points.isOf(lens)) return this.ofEye.blendTarget;
    this.ofEye?.points.made.free();
    const { width, height } = lens;
    const points = new Points(this.drawing, this.cameras, this.programs, width, height);
    const { made } = points;
    const { halves, floats, byte, bytes } = this.kinds;
    const whole = (kind) => made.add(kind, width, height);
    const [shown, known] = this.drawing.blendable(width, height, 2).map((each) => made.take(each));
    const textures = { shown, known, missed: whole(halves), shade: whole(byte), inner: whole(byte), faded: whole(halves) };
    Object.assign(textures, { sums: made.add(floats, SUMMED, SUMMED), valid: whole(floats), carried: whole(floats) });
    const { missed, shade, inner, faded, sums, valid, carried } = textures;
    this.ofEye = {
      points,
      ...textures,
      blendTarget: made.target(shown, known),
      missedTarget: made.target(missed, shade),
      innerTarget: made.target(inner),
      fadedTarget: made.target(faded),
      sumTarget: made.target(sums),
      validTarget: made.target(valid),
      carriedTarget: made.target(carried),
      pairTarget: made.target(whole(bytes)),
    };
    return this.ofEye.blendTarget;
  }

  /**
   * Compute a residual: the model is deformed to its frame, and its picture is blended in ownTarget().
   * @param {Wanted} wanted
   * @param {import("./trainingpictures.js").Picture} picture
   */
  measure({ eye, frame }, picture) {
    const { gl, programs, kinds } = this;
    const { points: { width, height }, shown, known, missed, faded, shade, inner, sums, ...targets } = this.ofEye;
    const { lens } = this.pictures.eyes[eye];
    const coded = new Textures(gl);
    const sizes = [[picture.width, picture.height], picture.chroma, picture.chroma];
    const [luma, blue, red] = picture.planes.map((plane, i) => coded.add(kinds.byte, ...sizes[i], plane));
    const mask = picture.mask && coded.add(kinds.bytes, width, height);
    if (mask) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, picture.mask);
    const smoke = this.light.smoke(gl, frame);
    if (smoke) coded.take(smoke);
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
    const [residual, depth, grey] = [kinds.halves, kinds.number, kinds.byte].map((kind) => made.add(kind, width, height));
    const centres = made.add(kinds.floats, ROW, this.drawing.rows);
    programs.RESIDUAL.use({ sums, faded, known, shade }, {});
    fillTarget(gl, made.target(residual, depth, grey), width, height);
    this.#copyCentres(made.target(centres));
    this.residuals.set(keyOf(eye, frame), { made, residual, depth, grey, centres, lens, pose });
  }

  #copyCentres(into) {
    const { gl, drawing } = this;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, drawing.stateTarget);
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, into);
    gl.blitFramebuffer(0, 0, ROW, drawing.rows, 0, 0, ROW, drawing.rows, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  /** Find what the model's motion leaves between two frames, whose residuals are there. @param {Pair} pair */
  async find({ eye, before, after }) {
    const key = `${eye} ${before} ${after}`;
    if (this.flows.get(key)) return;
    const { gl, programs } = this;
    const [first, second] = [before, after].map((frame) => this.residuals.get(keyOf(eye, frame)));
    this.ownTarget(eye);
    const { points, valid, carried, validTarget, carriedTarget, pairTarget } = this.ofEye;
    const { width, height } = points;
    programs.VALID_GREY.use({ residual: second.residual, grey: second.grey }, {});
    fillTarget(gl, validTarget, width, height);
    const view = { pose: first.pose, lens: first.lens, known: first.depth, centres: first.centres };
    const moved = points.motion(view, [second.centres, second.centres]);
    const shown = { ...second, residual: valid };
    points.carry(view, [shown, shown], moved, [1, 0], carriedTarget);
    programs.PAIR.use({ residual: first.residual, grey: first.grey, carried }, {});
    fillTarget(gl, pairTarget, width, height);
    const pictures = await this.drawing.read(width, height);
    const { w, h, flow } = await this.#flowBetween(pictures, width, height);
    const made = new Textures(gl);
    made.add(this.kinds.two, w, h, flow);
    this.flows.set(key, made);
  }

  #flowBetween(pictures, width, height) {
    return new Promise((resolve, reject) => {
      this.worker.onerror = () => reject(new CannotDrawError("A worker of the page could not start.", "no_worker"));
      this.worker.onmessage = ({ data }) => resolve(data);
      this.worker.postMessage({ pictures, width, height }, [pictures.buffer]);
    });
  }

  /**
   * What the view that is blended gets; its residuals and flows are there.
   * @param {number} t
   * @param {Matrix} pose
   * @param {import("./camera.js").Intrinsics} lens
   * @param {boolean} highlights whether to add light that one of two eyes misses alone
   * @returns {WebGLTexture | null} red, green and blue [H, W]; null: nothing
   */
  add(t, pose, lens, highlights) {
    const { gl, programs } = this;
    const { points, totals, totalTargets, sums, sumTarget, added, addedTarget } = this.#sized(lens);
    const view = { pose, lens, known: this.drawing.blended[1], centres: this.drawing.states[0] };
    const poses = this.pictures.eyes.map((_, eye) => this.eyePose(eye, t));
    const depth = points.depthInCells(view.known);
    const { eyes, nearest, isOwn, isDimmed, weights } = weightsOf(this.cameras, poses, view, depth, points.cells, highlights);
    const neighbours = this.neighbours(t);
    if (eyes.length === 0 || neighbours.length === 0) return null;
    gl.bindTexture(gl.TEXTURE_2D, points.weights);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ...points.cells, gl.RGBA, gl.FLOAT, weights);
    const [before, after = before] = neighbours.map(({ frame }) => frame);
    const shares = [neighbours[0].weight, neighbours[1]?.weight ?? 0];
    const residualsOf = (eye) => [before, after].map((frame) => this.residuals.get(keyOf(eye, frame)));
    const moved = points.motion(view, residualsOf(nearest).map(({ centres }) => centres));
    eyes.forEach((eye, place) => {
      const flow = this.flows.get(`${eye} ${before} ${after}`)?.all[0];
      const ways = neighbours.length === 2 ? points.correct(view, residualsOf(eye), moved, flow, shares) : moved;
      points.carry(view, residualsOf(eye), ways, shares, totalTargets[place]);
    });
    const [left, right] = eyes.length === 2 ? totals : [totals[0], totals[0]];
    if (eyes.length === 2) {
      programs.ALIKE.use({ left, right }, {});
      fillTarget(gl, sumTarget, lens.width, lens.height);
    }
    const counts = { eyes: ["1i", isOwn ? 0 : eyes.length], isDimmed: ["1i", isDimmed ? 1 : 0] };
    programs.TOGETHER.use({ left, right, sums, weights: points.weights }, counts);
    fillTarget(gl, addedTarget, lens.width, lens.height);
    return added;
  }

  /** What views of a size are computed with. */
  #sized(lens) {
    if (this.ofView?.points.isOf(lens)) return this.ofView;
    this.ofView?.points.made.free();
    const { width, height } = lens;
    const points = new Points(this.drawing, this.cameras, this.programs, width, height);
    const { made } = points;
    const { halves, floats } = this.kinds;
    const [sums, added, ...totals] = [floats, halves, halves, halves].map((kind) => made.add(kind, width, height));
    const totalTargets = totals.map((each) => made.target(each));
    this.ofView = { points, sums, added, totals, totalTargets, sumTarget: made.target(sums), addedTarget: made.target(added) };
    return this.ofView;
  }

  /** Let go of the recorded pictures; the GPU's memory goes with the drawing's. */
  close() {
    this.worker.terminate();
    this.pictures.close();
  }
}

/** What was used last, CACHED of it. */
class Recent {
  /** @param {(each: any) => void} forget */
  constructor(forget) {
    Object.assign(this, { forget, found: new Map() });
  }

  get(key) {
    const each = this.found.get(key);
    if (each !== undefined) this.#last(key, each);
    return each;
  }

  set(key, each) {
    this.#last(key, each);
    for (const [oldest, old] of this.found) {
      if (this.found.size <= CACHED) break;
      this.forget(old);
      this.found.delete(oldest);
    }
  }

  #last(key, each) {
    this.found.delete(key);
    this.found.set(key, each);
  }
}

const keyOf = (eye, frame) => `${eye} ${frame}`;
