// A scene on the GPU, drawn by WebGL2: deformed once for each time, blended for each view.

import { CannotDrawError, fillTarget, linked, matrix, padded, target, texture } from "./gpu.js";
import { STATE } from "./pack.js";
import { ADD, ALONG, BLEND, DEFORM, EVERYWHERE, MISSING, NUMBERS_ROW, ROW, SHOW, SPLAT, SUMS } from "./shaders.js";
import { halfEven } from "./trust.js";

/** Of intrasplat/view/unseen.py: shares of the picture's width. */
const SMOOTHED_SHARE = 1 / 128;
const STRIPE_SHARE = 1 / 96;
const TELL_EVERY_MS = 250;

export class Drawing {
  /**
   * @param {HTMLCanvasElement | OffscreenCanvas} canvas
   * @param {import("./table.js").Table} table
   * @param {{state: Float32Array, coefficients: Int16Array, stride: number, values: Float32Array | null}} packed
   */
  constructor(canvas, table, packed) {
    const options = { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true };
    const gl = (this.gl = canvas.getContext("webgl2", options));
    if (!gl?.getExtension("EXT_color_buffer_float")) throw new CannotDrawError("WebGL2 has no targets in floats.", "no_floats");
    // Without it blending in 32 bits is not allowed; 16 bits err by a level now and then.
    this.colourFormat = gl.getExtension("EXT_float_blend") ? gl.RGBA32F : gl.RGBA16F;
    Object.assign(this, { canvas, count: table.count, channels: table.channels, patterns: table.patterns });
    this.quads = packed.stride / 4;
    this.rows = Math.ceil(table.count / ROW);
    this.isKnown = packed.values !== null;
    this.#fill(packed);
    const link = (vertex, fragment) => linked(gl, vertex, fragment);
    this.deformer = link(EVERYWHERE, DEFORM);
    this.blender = link(SPLAT, BLEND);
    this.finder = link(EVERYWHERE, MISSING);
    this.along = link(EVERYWHERE, ALONG);
    this.shower = link(EVERYWHERE, SHOW);
    this.adder = link(EVERYWHERE, ADD);
    this.sumTarget = target(gl, [texture(gl, gl.RGBA32F, SUMS, SUMS, gl.RGBA, gl.FLOAT, null)]);
    this.ids = gl.createBuffer();
    this.instances = gl.createVertexArray();
    gl.bindVertexArray(this.instances);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
    const id = this.blender.attribute("gaussian");
    gl.enableVertexAttribArray(id);
    gl.vertexAttribIPointer(id, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(id, 1);
    gl.bindVertexArray(null);
    this.visible = 0;
    this.told = { unseen: 0, hardlySeen: 0 };
    this.toldAt = 0;
  }

  #fill({ state, coefficients, values }) {
    const { gl, rows } = this;
    const texels = coefficients.length / 4;
    const numberRows = Math.ceil(texels / NUMBERS_ROW);
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const needed = Math.max(rows, numberRows, NUMBERS_ROW);
    if (needed > most) {
      throw new CannotDrawError(`The scene needs textures of ${needed} texels; this GPU has ${most}.`, "too_large");
    }
    this.rest = texture(gl, gl.RGBA32F, (ROW * STATE) / 4, rows, gl.RGBA, gl.FLOAT, padded(state, ROW * STATE * rows));
    const numbers = padded(coefficients, 4 * NUMBERS_ROW * Math.max(numberRows, 1));
    const shape = [NUMBERS_ROW, Math.max(numberRows, 1)];
    this.numbers = texture(gl, gl.RGBA16I, ...shape, gl.RGBA_INTEGER, gl.SHORT, numbers);
    this.weights = texture(gl, gl.RGBA32F, Math.max(this.quads, 1), this.channels, gl.RGBA, gl.FLOAT, null);
    this.values = texture(gl, gl.R32F, ROW, rows, gl.RED, gl.FLOAT, padded(values ?? new Float32Array(0), ROW * rows));
    this.states = [0, 1, 2, 3].map(() => texture(gl, gl.RGBA32F, ROW, rows, gl.RGBA, gl.FLOAT, null));
    this.stateTarget = target(gl, this.states);
    this.size = null;
  }

  /** The Gaussians' state at a time. @param {Float32Array} patterns [channels, patterns] at it */
  deform(patterns) {
    const { gl, quads, channels } = this;
    if (quads > 0) {
      const wide = new Float32Array(4 * quads * channels);
      for (let c = 0; c < channels; c++) {
        wide.set(patterns.subarray(c * this.patterns, (c + 1) * this.patterns), 4 * quads * c);
      }
      gl.bindTexture(gl.TEXTURE_2D, this.weights);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, quads, channels, gl.RGBA, gl.FLOAT, wide);
    }
    this.deformer.use({ rest: this.rest, numbers: this.numbers, patterns: this.weights }, {
      count: ["1i", this.count],
      channels: ["1i", channels],
      quads: ["1i", quads],
    });
    fillTarget(gl, this.stateTarget, ROW, this.rows);
  }

  /**
   * What sorting found: Gaussians nearest first, and what is blended of them where that changes with time.
   * @param {Uint32Array} order
   * @param {Float32Array | null} values
   */
  arrange(order, values) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.STREAM_DRAW);
    this.visible = order.length;
    if (values === null) return;
    gl.bindTexture(gl.TEXTURE_2D, this.values);
    const data = padded(values, ROW * this.rows);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, this.rows, gl.RED, gl.FLOAT, data);
  }

  /**
   * Blend what deform() and arrange() prepared.
   * @param {number[][]} cameraFromWorld three rows, units
   * @param {import("./camera.js").Intrinsics} lens of the picture's size
   * @param {[number, number]} shine side and dim
   * @param {import("./camera.js").Enlargement} enlargement
   * @param {WebGLFramebuffer | null} into a target of that size; null: what show() shows
   */
  blend(cameraFromWorld, lens, shine, enlargement, into = null) {
    const { gl } = this;
    if (into === null) this.#resize(lens.width, lens.height);
    const [place, turn, size, colour] = this.states;
    this.blender.use({ place, turn, size, colour, values: this.values }, {
      cameraFromWorld: matrix(cameraFromWorld),
      lens: ["4f", lens.fx, lens.fy, lens.cx, lens.cy],
      picture: ["2f", lens.width, lens.height],
      shine: ["2f", ...shine],
      enlarged: ["2f", ...enlargement.enlarged],
      recorded: ["4f", ...enlargement.recorded],
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, into ?? this.blendTarget);
    gl.viewport(0, 0, lens.width, lens.height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.instances);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.visible);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }

  /**
   * Show what is blended.
   * @param {boolean} isMarked whether what no frame saw is hatched
   * @param {WebGLTexture | null} added to the colours
   */
  show(isMarked, added = null) {
    const { gl } = this;
    const [width, height] = this.size;
    const reach = ["1i", halfEven((width * SMOOTHED_SHARE) / 2)];
    this.finder.use({ known: this.blended[1] }, { isKnown: ["1i", this.isKnown ? 1 : 0] });
    fillTarget(gl, this.foundTarget, width, height);
    this.along.use({ found: this.found }, { reach });
    fillTarget(gl, this.alongTarget, width, height);
    this.shower.use({ shown: this.blended[0], along: this.counted, added: added ?? this.blended[0] }, {
      isAdded: ["1i", added === null ? 0 : 1],
      reach,
      stripe: ["1i", Math.max(2, halfEven(width * STRIPE_SHARE))],
      isMarked: ["1i", isMarked ? 1 : 0],
    });
    fillTarget(gl, this.finalTarget, width, height);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.finalTarget);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  #resize(width, height) {
    if (this.size?.[0] === width && this.size[1] === height) return;
    const { gl } = this;
    this.#free();
    this.canvas.width = width;
    this.canvas.height = height;
    this.size = [width, height];
    const bytes = () => texture(gl, gl.RGBA8, width, height, gl.RGBA, gl.UNSIGNED_BYTE, null);
    this.blended = this.blendable(width, height, 2);
    [this.found, this.counted] = [bytes(), bytes()];
    this.finals = [bytes(), bytes()];
    this.blendTarget = target(gl, this.blended);
    this.foundTarget = target(gl, [this.found]);
    this.alongTarget = target(gl, [this.counted]);
    this.finalTarget = target(gl, this.finals);
  }

  /** @returns {WebGLTexture[]} in which sums can be made */
  blendable(width, height, count) {
    const { gl, colourFormat } = this;
    const type = colourFormat === gl.RGBA32F ? gl.FLOAT : gl.HALF_FLOAT;
    return Array.from({ length: count }, () => texture(gl, colourFormat, width, height, gl.RGBA, type, null));
  }

  #free() {
    if (!this.size) return;
    const { gl } = this;
    for (const each of [...this.blended, this.found, this.counted, ...this.finals]) gl.deleteTexture(each);
    const targets = [this.blendTarget, this.foundTarget, this.alongTarget, this.finalTarget];
    for (const each of targets) gl.deleteFramebuffer(each);
  }

  /** Wait until all is drawn: for timing, since the GPU works on while the page does. */
  finish() {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, this.stateTarget);
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.FLOAT, new Float32Array(4));
  }

  /** Kept when the GPU has drawn all of it; the page works on meanwhile. */
  async settled() {
    const { gl } = this;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (fence && !gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) {
      await new Promise((resolve) => setTimeout(resolve, 1));
    }
    gl.deleteSync(fence);
  }

  /** The picture's pixels, from the top. @returns {Uint8Array} [height, width, 4] */
  pixels() {
    const { gl } = this;
    const [width, height] = this.size;
    const upside = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.finalTarget);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upside);
    const row = (i) => upside.subarray(4 * width * i, 4 * width * (i + 1));
    const pixels = new Uint8Array(upside.length);
    for (let i = 0; i < height; i++) pixels.set(row(height - 1 - i), 4 * width * i);
    return pixels;
  }

  /**
   * Shares of the picture that no frame saw, and that are hardly trusted; a moment old unless isNew is asked for.
   * @returns {{unseen: number, hardlySeen: number}}
   */
  shares(isNew = false) {
    const now = performance.now();
    if (!isNew && now - this.toldAt < TELL_EVERY_MS) return this.told;
    this.toldAt = now;
    const { gl } = this;
    this.adder.use({ told: this.finals[1] }, {});
    fillTarget(gl, this.sumTarget, SUMS, SUMS);
    const sums = new Float32Array(4 * SUMS * SUMS);
    gl.readPixels(0, 0, SUMS, SUMS, gl.RGBA, gl.FLOAT, sums);
    const [unseen, hardlySeen] = [0, 1].map((i) => sums.reduce((sum, each, at) => sum + (at % 4 === i ? each : 0), 0));
    const pixels = this.size[0] * this.size[1];
    this.told = { unseen: unseen / pixels, hardlySeen: hardlySeen / pixels };
    return this.told;
  }

  /** What the target that was drawn into last shows, as soon as it is drawn. @returns {Promise<Uint8Array>} [height, width, 4] */
  async read(width, height) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, 4 * width * height, gl.STREAM_READ);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, 0);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    await this.settled();
    const pixels = new Uint8Array(4 * width * height);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, pixels);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    gl.deleteBuffer(buffer);
    return pixels;
  }

  /** Give the GPU's memory back. */
  close() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}
