// A finished scene in this browser's memory: downloaded and decoded once while the service draws, then drawn here. It is
// kept nowhere else: nothing of a patient stays in the browser's cache.

import { bodyOf, getReport, request } from "../base/api.js";
import { soon } from "../base/events.js";
import { insist } from "../base/pause.js";
import { Problem } from "../base/problem.js";
import { readChoice, writeChoice } from "../base/storage.js";
import { DamagedError } from "../player/decode.js";
import { Detail } from "../player/detail.js";
import { CannotDrawError } from "../player/gpu.js";
import { DETAIL, Player } from "../player/player.js";
import { graphics } from "../player/support.js";

const SCENE = "scene.safetensors";
const PARTIAL = 206;
const EYES = ["left", "right"];
const MAX_SIDE_PX = 4096;
const STORED_AS = "intrasplat-drawing";
/** Whether this browser draws: where it has a graphics processor, wherever it can, or never. */
export const CHOICES = ["automatic", "always", "never"];

/** @typedef {import("./stream.js").View} View */
/** @typedef {import("./stream.js").Picture} Picture */

/** Tells "changed" of all that decides who draws. */
export class Memory extends EventTarget {
  /** @param {() => boolean} mayDownload whether the key has the scope */
  constructor(mayDownload) {
    super();
    this.mayDownload = mayDownload;
    /** @type {Player | null} */
    this.player = null;
    this.choice = storedChoice();
    this.open(null);
  }

  /** @param {string | null} scene that comes into view; any other is let go of */
  open(scene) {
    this.loading?.abort();
    this.player?.close();
    Object.assign(this, { scene, player: null, loading: null, refused: null, step: "", share: 0 });
    this.#tell();
  }

  /** @param {"automatic"|"always"|"never"} choice kept for the next visit */
  choose(choice) {
    this.choice = choice;
    writeChoice(STORED_AS, choice);
    this.open(this.scene);
  }

  /**
   * Why the service draws a view; null: this browser does.
   * @param {Pick<View, "scene" | "layer" | "eye" | "light">} view
   * @param {"running"|"done"|undefined} state of what is shown
   * @returns {string | null} a code
   */
  whyNot({ scene, layer, eye = "left", light = "steady" }, state) {
    if (this.choice === "never") return "never";
    const found = graphics();
    if (!found.canDraw || (!found.isFast && this.choice !== "always")) return found.why;
    if (layer === "recorded") return "recorded";
    if (state === "running") return "training";
    if (!this.mayDownload()) return "no_scope";
    if (this.refused) return this.refused;
    if (this.player === null || this.scene !== scene) return "loading";
    if (light === "recorded" && this.player.hasRecordedLight) return "layer";
    return layer === "rgb" && eye === "left" ? null : "layer"; // the right eye's lens is known to the service alone
  }

  /** A finished scene is in view: load it, unless something is in the way or it is done. @param {View} view */
  want(view) {
    if (this.loading || this.player || this.whyNot(view, "done") !== "loading") return;
    this.#load(view.scene);
  }

  /**
   * Draw a view; its picture is on the image until the next one is.
   * @param {View} view
   * @param {{width: number, height: number}} room in pixels of the screen
   * @param {{isMoving: boolean, isTimed: boolean, isRefined?: boolean, isOutdated?: () => boolean}} how as the player's View
   * @returns {Promise<Picture>}
   */
  async draw(view, room, how) {
    const { player } = this;
    const { cameras, canvas } = player;
    const pose = cameras.standing(view.pose ?? null, cameras.shownTime(view.t));
    const { width, height } = cameras.intrinsics;
    const longest = MAX_SIDE_PX / Math.max(width, height);
    const size = cameras.drawnSize(Math.min(room.width / width, room.height / height, longest));
    const isMarked = view.unseen === "mark";
    const drawn = await player.draw({ t: view.t, pose, ...size, highlights: view.highlights === "on", isMarked, ...how });
    return {
      image: canvas,
      scene: view.scene,
      state: "done",
      t: drawn.t,
      iteration: null,
      unseen: drawn.unseen,
      codes: drawn.warnings.map(({ code }) => code),
      totalMs: NaN,
      camera: { ...cameras.resized(size.width, size.height), world_from_camera: pose.slice(0, 3).flat() },
      way: "memory",
      isMoving: how.isMoving,
      hasDetail: drawn.hasDetail,
    };
  }

  /** The service draws from now on. @param {Error} error why */
  giveUp(error) {
    const refused = codeOf(error);
    if (refused === "fault") console.error(error);
    this.open(this.scene);
    this.refused = refused;
    this.#tell();
  }

  async #load(scene) {
    const loading = (this.loading = new AbortController());
    const isStill = () => this.loading === loading;
    const onShare = (step) => (share) => isStill() && this.#tell(step, share);
    try {
      const files = await download(scene, loading.signal, onShare("download"));
      const canvas = document.createElement("canvas");
      const player = await Player.of(files, canvas, onShare("decode"), loading.signal);
      if (!isStill()) return player.close();
      canvas.addEventListener("webglcontextlost", () => {
        if (this.player === player) this.giveUp(new CannotDrawError("The GPU has dropped the scene.", "context_lost"));
      });
      if (player.hasDetail) player.takeDetail(() => Detail.of(player, picturesOf(scene, files.manifest)));
      this.player = player;
      this.loading = null;
      this.#tell();
    } catch (error) {
      if (isStill()) this.giveUp(error);
    }
  }

  #tell(step = "", share = 0) {
    Object.assign(this, { step, share });
    this.dispatchEvent(new Event("changed"));
  }
}

function storedChoice() {
  const stored = readChoice(STORED_AS);
  return CHOICES.includes(stored) ? stored : "automatic";
}

/** @param {Error} error @returns {string} why this browser does not draw */
function codeOf(error) {
  if (error instanceof DamagedError || error instanceof SyntaxError) return "damaged";
  if (error instanceof CannotDrawError) return error.code;
  if (error instanceof RangeError) return "too_large"; // no memory for an array
  if (error instanceof Problem) return error.status === 401 || error.status === 403 ? "no_scope" : "no_file";
  return "fault";
}

/** @returns {Promise<{manifest: Record<string, any>, scene: ArrayBuffer}>} */
async function download(id, signal, onShare) {
  const path = `/scenes/${id}/files/`;
  const patiently = (work) => insist(work, () => {}, signal);
  const manifest = await patiently(async () => (await request(`${path}manifest.json`, { signal })).json());
  const bytes = manifest.files?.[SCENE]?.bytes;
  if (!bytes) throw new DamagedError("The manifest names no scene.");
  const got = { tag: "", length: 0, parts: [] };
  await patiently(() => goOn(`${path}${SCENE}`, got, signal, () => onShare(got.length / bytes)));
  return { manifest, scene: await new Blob(got.parts).arrayBuffer() };
}

/** @returns {import("../player/trainingpictures.js").Source} */
function picturesOf(id, manifest) {
  const count = manifest.world_from_camera.length;
  let isMasked = null; // a promise
  return {
    bytes: manifest.beside[DETAIL].bytes,
    async read(first, end, signal) {
      const headers = { Range: `bytes=${first}-${end - 1}` };
      const response = await request(`/scenes/${id}/files/${DETAIL}`, { signal, headers });
      const bytes = new Uint8Array(await bodyOf(response, "arrayBuffer"));
      return response.status === PARTIAL ? bytes : bytes.subarray(first, end);
    },
    async mask(eye, frame, signal) {
      isMasked ??= getReport(id).then(({ recorded }) => recorded?.masks === true);
      isMasked.catch(() => (isMasked = null));
      if (!(await isMasked)) return null;
      const query = new URLSearchParams({ t: String(frame / count), eye: EYES[eye], masks: "only" });
      return bodyOf(await request(`/scenes/${id}/recorded?${query}`, { signal }), "blob");
    },
  };
}

/** Download what is left of a file. */
async function goOn(path, got, signal, onPart) {
  const headers = got.length > 0 ? { Range: `bytes=${got.length}-`, "If-Range": got.tag } : {};
  const response = await request(path, { signal, headers });
  got.tag = response.headers.get("ETag");
  if (response.status !== PARTIAL) Object.assign(got, { length: 0, parts: [] });
  const reader = response.body.getReader();
  while (true) {
    const { value, done } = await soon(reader);
    if (done) return;
    got.parts.push(value);
    got.length += value.length;
    onPart();
  }
}
