// The cameras of a scene: where the endoscope was, where a viewer stands, and what it sees of the gloss
// (intrasplat/view/camera.py, intrasplat/pose.py). Matrices are rows; poses are world_from_camera in mm.

/** Optimiser units of the clip's median depth (intrasplat/train/targets.py). */
const MEDIAN_DEPTH_UNITS = 60;
/** Distance from the line between the eyes, in baselines, at which the gloss has faded to exp(-1/2). */
const FADING = 1.0;
/** Pixels in which a picture is judged at most (intrasplat/view/render.py). */
const MAX_JUDGED_PIXELS = 2 ** 21;

/** @typedef {number[][]} Matrix */
/** @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number}} Intrinsics pixels */
/**
 * enlarged: by how much the focal lengths exceed the recording's. recorded: its camera_from_world's third row, in units.
 * Zeros: nothing is enlarged.
 * @typedef {{enlarged: [number, number], recorded: number[]}} Enlargement
 */
/** @typedef {{poses: Matrix[], frameTimesS: number[], trainedFrames: number[]}} Recording */

const dot = (a, b) => a.reduce((sum, each, i) => sum + each * b[i], 0);
const column = (m, j) => m.map((row) => row[j]);
/** @param {Matrix} a @param {Matrix} b both 4 x 4 @returns {Matrix} */
export const times = (a, b) => a.map((row) => [0, 1, 2, 3].map((j) => dot(row, column(b, j))));
/** @param {Matrix} pose a rotation and a shift @returns {Matrix} */
export function inverse(pose) {
  const [turned, centre] = [[0, 1, 2].map((j) => column(pose, j).slice(0, 3)), centreOf(pose)];
  return [...turned.map((row) => [...row, -dot(row, centre)]), [0, 0, 0, 1]];
}
const centreOf = (pose) => pose.slice(0, 3).map((row) => row[3]);

/** A scene's manifest, as far as cameras need it. */
export class Cameras {
  /** @param {Record<string, any>} manifest */
  constructor(manifest) {
    this.poses = manifest.world_from_camera;
    this.frameTimesS = manifest.frame_times_s;
    this.frameCount = this.poses.length;
    this.trainedTimes = manifest.trained_t;
    this.trainedFrames = manifest.trained_t.map((t) => Math.round(t * this.frameCount));
    this.intrinsics = manifest.intrinsics;
    this.unitsPerMm = manifest.units_per_mm;
    this.rightEyeMm = manifest.right_eye_mm ?? null;
    this.moves = this.poses.some((pose) => pose.some((row, i) => row.some((each, j) => each !== this.poses[0][i][j])));
  }

  /** The time that is shown for t: within the clip. @param {number} t */
  shownTime(t) {
    return Math.min(Math.max(t, 0), (this.frameCount - 1) / this.frameCount);
  }

  /** @param {number} t model time @returns {number} seconds from the first frame */
  seconds(t) {
    const place = Math.min(Math.max(t * this.frameCount, 0), this.frameCount - 1);
    const before = Math.min(Math.floor(place), Math.max(this.frameCount - 2, 0));
    const next = this.frameTimesS[before + 1] ?? this.frameTimesS[before];
    return this.frameTimesS[before] + (place - before) * (next - this.frameTimesS[before]);
  }

  /** @param {number} seconds from the first frame @returns {number} model time, within the clip */
  timeAt(seconds) {
    const later = this.frameTimesS.findIndex((each) => each - this.frameTimesS[0] > seconds);
    if (later < 0) return this.shownTime(1);
    if (later === 0) return 0;
    const [before, next] = [this.frameTimesS[later - 1], this.frameTimesS[later]];
    return (later - 1 + (seconds + this.frameTimesS[0] - before) / (next - before)) / this.frameCount;
  }

  /** @param {number} t @returns {Matrix} of the endoscope's left eye, between frames interpolated */
  endoscope(t) {
    const place = Math.min(Math.max(t * this.frameCount, 0), this.frameCount - 1);
    const before = Math.min(Math.floor(place), Math.max(this.frameCount - 2, 0));
    const [first, second] = [this.poses[before], this.poses[before + 1] ?? this.poses[before]];
    const share = place - before;
    if (share === 0 || !this.moves) return first;
    const rotation = between(first, second, share);
    const rows = rotation.map((row, i) => [...row, (1 - share) * first[i][3] + share * second[i][3]]);
    return [...rows, [0, 0, 0, 1]];
  }

  /** @param {number} t @returns {Matrix} of the endoscope's right eye; the left one's if there is none */
  rightEye(t) {
    const left = this.endoscope(t);
    if (this.rightEyeMm === null) return left;
    return left.map((row, i) => (i < 3 ? [...row.slice(0, 3), row[3] + dot(row.slice(0, 3), this.rightEyeMm)] : row));
  }

  /** The median depth of the tissue, mm. */
  get depthMm() {
    return MEDIAN_DEPTH_UNITS / this.unitsPerMm;
  }

  /**
   * See intrasplat/pose.py.
   * @param {number[]} [about] x, y, z of the point looked at; by default the median-depth point on frame 0's axis
   * @returns {Matrix}
   */
  orbit(yawDeg, pitchDeg, zoom, ...about) {
    const [yaw, pitch] = [-yawDeg, -pitchDeg].map((degrees) => (degrees * Math.PI) / 180);
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const { depthMm } = this;
    const point = about.length === 3 ? about : [0, 0, depthMm];
    const rotation = [[cy, sy * sp, sy * cp], [0, cp, -sp], [-sy, cy * sp, cy * cp]];
    return [...rotation.map((row, i) => [...row, point[i] - (row[2] * depthMm) / zoom]), [0, 0, 0, 1]];
  }

  /**
   * @param {string | null} pose as the service spells it (intrasplat/pose.py); null is the endoscope's own
   * @param {number} t the time that is shown
   * @returns {Matrix}
   */
  standing(pose, t) {
    if (pose === null) return this.endoscope(t);
    const numbers = pose.replace("orbit:", "").split(/[,\s]+/).filter(Boolean).map(Number);
    if (pose.startsWith("orbit:")) return this.orbit(...numbers);
    return [...[0, 4, 8].map((i) => numbers.slice(i, i + 4)), [0, 0, 0, 1]];
  }

  /**
   * side and dim of intrasplat/splat/camera.py for a camera there.
   * @param {number} t
   * @param {Matrix} pose
   * @param {boolean} highlights
   * @returns {[number, number]}
   */
  gloss(t, pose, highlights) {
    if (this.rightEyeMm === null) return [0, 0];
    if (!highlights) return [0, 0.5];
    const left = this.endoscope(t);
    const baseline = [0, 1, 2].map((i) => dot(left[i].slice(0, 3), this.rightEyeMm));
    const fromLeft = centreOf(pose).map((each, i) => each - left[i][3]);
    const length = Math.hypot(...baseline);
    const along = Math.min(Math.max(dot(fromLeft, baseline) / length ** 2, 0), 1);
    const away = Math.hypot(...fromLeft.map((each, i) => each - along * baseline[i])) / length;
    return [Math.exp(-0.5 * (away / FADING) ** 2) * (along - 0.5), 0];
  }

  /**
   * By how much a view enlarges the recording (docs/rasterizer.md, "Pixels of the recording").
   * @param {number} t
   * @param {Matrix} pose
   * @param {Intrinsics} lens
   * @returns {Enlargement}
   */
  enlargement(t, pose, lens) {
    const recorder = this.#nearestRecorder(t, centreOf(pose));
    const enlarged = [lens.fx / this.intrinsics.fx, lens.fy / this.intrinsics.fy];
    const isOwn = [0, 1, 2].every((i) => recorder[i][2] === pose[i][2] && recorder[i][3] === pose[i][3]);
    if (isOwn && Math.max(...enlarged) <= 1) return { enlarged: [0, 0], recorded: [0, 0, 0, 0] };
    return { enlarged, recorded: this.cameraFromWorld(recorder)[2] };
  }

  /** The endoscope, at t or at a trained frame, where it was nearest to a place. */
  #nearestRecorder(t, centre) {
    const far = (pose) => Math.hypot(...centreOf(pose).map((each, i) => each - centre[i]));
    const own = this.endoscope(t);
    return this.trainedFrames.map((frame) => this.poses[frame]).reduce((a, b) => (far(b) < far(a) ? b : a), own);
  }

  /** @param {Matrix} pose @returns {Matrix} three rows that turn places in units into the camera's axes */
  cameraFromWorld(pose) {
    return this.inUnits(inverse(pose));
  }

  /** @param {Matrix} rows of a rotation and a shift in mm @returns {Matrix} three rows, the shift in units */
  inUnits(rows) {
    return rows.slice(0, 3).map((row) => [...row.slice(0, 3), row[3] * this.unitsPerMm]);
  }

  /**
   * The size of a picture so many times as wide as the clip's, but no coarser than what is shown is judged in: unseen
   * shares and warnings would depend on the screen (docs/conventions.md, "Size of a picture").
   * @param {number} scale
   * @returns {{width: number, height: number}} pixels
   */
  drawnSize(scale) {
    const { width, height } = this.intrinsics;
    const held = Math.max(scale, Math.min(1, Math.sqrt(MAX_JUDGED_PIXELS / (width * height))));
    return { width: Math.max(1, Math.round(width * held)), height: Math.max(1, Math.round(height * held)) };
  }

  /** The clip's camera for a picture of another size: what it sees stays whole. @returns {Intrinsics} */
  resized(width, height) {
    const { width: w, height: h, fx, fy, cx, cy } = this.intrinsics;
    const [x, y] = [width / w, height / h];
    return { width, height, fx: fx * x, fy: fy * y, cx: cx * x, cy: cy * y };
  }
}

/** The rotation at a share of the way from one to another (slerp). @returns {Matrix} three rows of three */
function between(first, second, share) {
  const a = quaternionOf(first);
  let b = quaternionOf(second);
  if (dot(a, b) < 0) b = b.map((each) => -each);
  const angle = Math.acos(Math.min(1, dot(a, b)));
  const [p, q] = angle < 1e-9 ? [1 - share, share] : [Math.sin((1 - share) * angle), Math.sin(share * angle)];
  const mixed = a.map((each, i) => p * each + q * b[i]);
  const length = Math.hypot(...mixed);
  const [w, x, y, z] = mixed.map((each) => each / length);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/** @param {Matrix} m a rotation @returns {number[]} w, x, y, z */
function quaternionOf(m) {
  const [a, b, c] = [m[0][0], m[1][1], m[2][2]];
  const squares = [1 + a + b + c, 1 + a - b - c, 1 - a + b - c, 1 - a - b + c];
  const best = squares.indexOf(Math.max(...squares));
  const [x, y, z] = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]];
  const [xy, xz, yz] = [m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]];
  const rows = [[squares[0], x, y, z], [x, squares[1], xy, xz], [y, xy, squares[2], yz], [z, xz, yz, squares[3]]];
  const found = rows[best];
  const length = Math.hypot(...found);
  return found.map((each) => each / length);
}
