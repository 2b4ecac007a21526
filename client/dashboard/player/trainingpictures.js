// The recorded pictures of a scene's training frames, read as they are needed from its detail.mkv and its masks
// (intrasplat/scene/training_pictures.py). Symbols: h w pixels of a picture.

import { DamagedError } from "./decode.js";
import { CannotDrawError } from "./gpu.js";
import { blocksOf, headOf, keysOf } from "./matroska.js";

const RATE_HZ = 25;
const TAG = "INTRASPLAT";
const HEAD_BYTES = 2 ** 16;
const FRAME_US = 1e6 / RATE_HZ;
/** Runs of frames between key frames that stay decoded, and pictures with their masks: of two eyes now and shortly after. */
const RUNS = 6;
const PICTURES = 16;
/** While the view moves, so many frames are prepared, and the runs and masks of those beyond are loaded. */
const [AHEAD, FAR_AHEAD] = [3, 12];
/** How many pixels share a number of chroma, across and down. */
const SHARED = { I420: 2, NV12: 2 };

/**
 * Where the files are. bytes: of detail.mkv. mask: a PNG, opaque on instruments; null: the scene has no masks.
 * @typedef {{bytes: number, read: (first: number, end: number, signal: AbortSignal) => Promise<Uint8Array>,
 *   mask: (eye: number, frame: number, signal: AbortSignal) => Promise<Blob | null>}} Source
 */
/** @typedef {{lens: import("./camera.js").Intrinsics, leftFromEye: number[][]}} Eye */
/**
 * Y Cb Cr in full range (BT.601), top row first; of padded size, while the eye's lens has the true one.
 * @typedef {{width: number, height: number, chroma: [number, number], planes: Uint8Array[]}} Coded
 */
/** @typedef {Coded & {mask: ImageBitmap | null}} Picture */

export class TrainingPictures {
  /**
   * @param {Source} source
   * @returns {Promise<TrainingPictures>}
   * @throws CannotDrawError (no_codec), DamagedError, or what the source throws
   */
  static async open(source) {
    if (typeof VideoDecoder === "undefined") throw new CannotDrawError("This browser decodes no videos here.", "no_codec");
    const controller = new AbortController();
    const head = headOf(await source.read(0, Math.min(HEAD_BYTES, source.bytes), controller.signal), TAG);
    const keys = keysOf(await source.read(head.cuesAt, source.bytes, controller.signal), head);
    const { frames, eyes } = JSON.parse(head.tag);
    const configs = head.tracks.map(configOf);
    for (const config of configs) {
      const { supported } = await VideoDecoder.isConfigSupported(config);
      if (!supported) throw new CannotDrawError(`This browser does not decode ${config.codec}.`, "no_codec");
    }
    if (configs.length !== eyes.length || frames.length === 0) throw new DamagedError("An eye's recorded frames are missing.");
    return new TrainingPictures(source, controller, head, keys, frames, eyes.map(eyeOf), configs);
  }

  /** Use TrainingPictures.open(). */
  constructor(source, controller, head, keys, frames, eyes, configs) {
    Object.assign(this, { source, controller, frames, eyes, configs, scaleS: head.scaleS, cuesAt: head.cuesAt });
    this.numbers = head.tracks.map(({ number }) => number);
    const sorted = keys.map((key) => ({ ...key, frame: frameAt(key.time) })).sort((a, b) => a.frame - b.frame);
    this.keys = this.numbers.map((number) => sorted.filter((key) => key.number === number));
    this.starts = [...new Set(sorted.map(({ at }) => at))].sort((a, b) => a - b);
    this.chunks = new Map(); // bytes, by their place in the file
    this.runs = new Map(); // decoded frames, by eye and run
    this.masks = new Map();
    /** @type {Map<string, Promise<Picture>>} */
    this.pictures = new Map();
    /** @type {Map<string, Picture>} those that are there */
    this.ready = new Map();
  }

  /** @returns {Picture | null} null: not there yet; it comes */
  at(eye, frame) {
    this.#picture(eye, frame).catch(() => {}); // who waits for it is told
    return this.ready.get(`${eye} ${frame}`) ?? null;
  }

  /** @returns {Promise<Picture>} */
  load(eye, frame) {
    return this.#picture(eye, frame);
  }

  /** Prepare what comes after a frame. */
  ahead(eye, frame) {
    const place = this.frames.indexOf(frame);
    this.frames.slice(place + 1, place + 1 + FAR_AHEAD).forEach((each, i) => {
      const work = i < AHEAD ? this.#picture(eye, each) : Promise.all([this.#run(eye, each), this.#mask(eye, each)]);
      work.catch(() => {});
    });
  }

  /** Let go of all, and of what is on its way. */
  close() {
    this.controller.abort();
    for (const { mask } of this.ready.values()) mask?.close();
    for (const each of [this.chunks, this.runs, this.masks, this.pictures, this.ready]) each.clear();
  }

  #picture(eye, frame) {
    return once(this.pictures, `${eye} ${frame}`, PICTURES, async (key) => {
      const [run, blob] = await Promise.all([this.#run(eye, frame), this.#mask(eye, frame)]);
      const coded = run.get(frame);
      if (!coded) throw new DamagedError(`The recorded frames have no frame ${frame}.`);
      const picture = { ...coded, mask: blob && (await createImageBitmap(blob)) };
      if (this.pictures.has(key) && !this.controller.signal.aborted) this.ready.set(key, picture);
      else picture.mask?.close();
      return picture;
    }, (key) => {
      this.ready.get(key)?.mask?.close();
      this.ready.delete(key);
    });
  }

  #mask(eye, frame) {
    return once(this.masks, `${eye} ${frame}`, Infinity, () => this.source.mask(eye, frame, this.controller.signal));
  }

  /** Frames from one that is coded by itself to the next. @returns {Promise<Map<number, Coded>>} */
  #run(eye, frame) {
    const place = this.keys[eye].findLastIndex((key) => key.frame <= frame);
    return once(this.runs, `${eye} ${place}`, RUNS, async () => {
      const [from, to] = [this.keys[eye][place]?.frame, this.keys[eye][place + 1]?.frame ?? Infinity];
      const count = this.frames.filter((each) => each >= from && each < to).length;
      const found = [];
      // Its last frames may lie in the cluster that the next one begins.
      for (let at = this.starts.indexOf(this.keys[eye][place]?.at); found.length < count; at++) {
        for (const { number, time, data } of blocksOf(await this.#chunk(at), this.scaleS)) {
          const coded = frameAt(time);
          if (number === this.numbers[eye] && coded >= from && coded < to) found.push({ frame: coded, data });
        }
      }
      return decoded(this.configs[eye], found);
    });
  }

  #chunk(at) {
    const [first, end] = [this.starts[at], this.starts[at + 1] ?? this.cuesAt];
    if (first === undefined) return Promise.reject(new DamagedError("A part of the recorded frames is missing."));
    return once(this.chunks, first, Infinity, () => this.source.read(first, end, this.controller.signal));
  }
}

const frameAt = (timeS) => Math.round(timeS * RATE_HZ);

/** Some work's result; what failed is tried again. At most so many stay, those asked for last. */
function once(found, key, most, work, forget = () => {}) {
  const known = found.get(key);
  found.delete(key);
  const made = known ?? work(key);
  found.set(key, made);
  if (!known) made.catch(() => found.get(key) === made && found.delete(key));
  for (const oldest of found.keys()) {
    if (found.size <= most) break;
    found.delete(oldest);
    forget(oldest);
  }
  return made;
}

/** @returns {Eye} */
function eyeOf({ left_from_eye: pose, ...lens }) {
  return { lens, leftFromEye: [0, 4, 8, 12].map((i) => pose.slice(i, i + 4)) };
}

/** @param {import("./matroska.js").Track} track @returns {VideoDecoderConfig} */
function configOf({ codec, description, width, height }) {
  const profile = [...(description?.subarray(1, 4) ?? [])].map((each) => each.toString(16).padStart(2, "0")).join("");
  const codecs = { "V_MPEG4/ISO/AVC": { codec: `avc1.${profile}`, description }, V_VP9: { codec: "vp09.00.40.08" } };
  if (!codecs[codec]) throw new DamagedError(`The recorded frames are coded as ${codec}.`);
  return { ...codecs[codec], codedWidth: width, codedHeight: height, hardwareAcceleration: "prefer-software" };
}

/** @returns {Promise<Map<number, Coded>>} the frames of packets, the first of which is coded by itself */
async function decoded(config, packets) {
  const frames = new Map();
  const copies = [];
  let decoder = null;
  await new Promise((resolve, reject) => {
    const output = (frame) => {
      const copy = copied(frame).then((each) => frames.set(Math.round(frame.timestamp / FRAME_US), each));
      copies.push(copy.finally(() => frame.close()));
    };
    decoder = new VideoDecoder({ output, error: reject });
    decoder.configure(config);
    packets.forEach(({ frame, data }, i) => {
      decoder.decode(new EncodedVideoChunk({ type: i === 0 ? "key" : "delta", timestamp: frame * FRAME_US, data }));
    });
    decoder.flush().then(resolve, reject);
  }).finally(() => decoder?.state !== "closed" && decoder?.close());
  await Promise.all(copies);
  return frames;
}

/** @param {VideoFrame} frame @returns {Promise<Coded>} */
async function copied(frame) {
  const shared = SHARED[frame.format];
  if (!shared) throw new CannotDrawError(`This browser decodes videos to ${frame.format}.`, "no_codec");
  const { width, height } = frame.visibleRect;
  const bytes = new Uint8Array(frame.allocationSize());
  const layout = await frame.copyTo(bytes);
  const chroma = [Math.ceil(width / shared), Math.ceil(height / shared)];
  const plane = (place, [across, down], step = 1, shift = 0) => {
    const { offset, stride } = layout[place];
    const packed = new Uint8Array(across * down);
    for (let i = 0; i < down; i++) {
      const row = bytes.subarray(offset + i * stride, offset + i * stride + across * step);
      if (step === 1) packed.set(row, i * across);
      else for (let j = 0; j < across; j++) packed[i * across + j] = row[step * j + shift];
    }
    return packed;
  };
  const colours = layout.length === 3 ? [plane(1, chroma), plane(2, chroma)] : [plane(1, chroma, 2, 0), plane(1, chroma, 2, 1)];
  return { width, height, chroma, planes: [plane(0, [width, height]), ...colours] };
}
