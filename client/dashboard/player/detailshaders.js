// What the GPU computes of a view's detail. The contract is intrasplat/view/detail.py and transfer.py; lengths are in units.
// Pictures are as the blend leaves them, last row first; coded planes and grids of cells have the first row first.

import { CELL_PX } from "./flow.js";
import { HEAD, ROW } from "./shaders.js";

/** Blocks along a sum of the picture. */
export const SUMMED = 32;

const TOOLS = `${HEAD}
const float COVERED = 0.5, LEAST_Z = 1e-4;
// Of what was blended, or of a texture of depths, whose other numbers are 0, 0 and 1.
float solidDepth(vec4 known) {
  float alpha = 1.0 - known.a;
  if (alpha == 0.0) return known.r;
  return alpha >= COVERED ? known.r / alpha : 0.0;
}
// Four numbers about a place between texels, whose borders count as repeated.
vec4 between(sampler2D from, vec2 place) {
  ivec2 last = textureSize(from, 0) - 1;
  place = clamp(place, vec2(0.0), vec2(last));
  ivec2 a = ivec2(place), b = min(a + 1, last);
  vec2 f = place - vec2(a);
  vec4 above = mix(texelFetch(from, a, 0), texelFetch(from, ivec2(b.x, a.y), 0), f.x);
  return mix(above, mix(texelFetch(from, ivec2(a.x, b.y), 0), texelFetch(from, b, 0), f.x), f.y);
}
// Where a texture of another size shows a pixel.
vec2 scaled(vec2 pixel, sampler2D from, vec2 size) { return (pixel + 0.5) * vec2(textureSize(from, 0)) / size - 0.5; }
int mirrored(int x, int count) {
  if (count == 1) return 0;
  int period = 2 * (count - 1), at = abs(x) % period;
  return at >= count ? period - at : at;
}
`;

/** What the model misses of a recorded picture, in steady light and without smoke, and whether that is known; its grey. */
export const MISSED = `${TOOLS}
uniform sampler2D shown, known, luma, blue, red, mask, smoke;
uniform bool isMasked, isSmoky;
uniform vec4 lens, own;                         // fx, fy, cx, cy of the eye, and of the endoscope
uniform vec2 ownSize;
uniform mat4 endoscopeFromEye, lampFromEye;
uniform vec3 gains;
uniform vec2 vignetting;                        // power, logarithm of the level
uniform vec4 airlight;                          // and the smoke's reference depth
layout(location = 0) out vec4 missed;
layout(location = 1) out vec4 grey;
const float MIN_TRANSMISSION = 0.3, MIN_LIGHT = 0.2, LEAST_LOG_COSINE = -3.0;
vec3 recordedAt(ivec2 at) {
  vec2 size = vec2(textureSize(luma, 0));
  float y = texelFetch(luma, at, 0).r * 255.0;
  vec2 chroma = vec2(between(blue, scaled(vec2(at), blue, size)).r, between(red, scaled(vec2(at), red, size)).r);
  chroma = floor(chroma * 255.0 + 0.5) - 128.0;
  vec3 rgb = y + vec3(1.403 * chroma.y, -0.714 * chroma.y - 0.344 * chroma.x, 1.773 * chroma.x);
  return clamp(floor(rgb + 0.5), 0.0, 255.0) / 255.0;
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), size = textureSize(shown, 0);
  ivec2 pixel = ivec2(at.x, size.y - 1 - at.y);
  float depth = solidDepth(texelFetch(known, at, 0));
  vec4 point = vec4(depth * vec3((vec2(pixel) + 0.5 - lens.zw) / lens.xy, 1.0), 1.0);
  vec3 steady = recordedAt(pixel);
  bool isValid = depth > 0.0 && !(isMasked && texelFetch(mask, pixel, 0).a > 0.0);
  if (isSmoky) {
    vec3 there = (endoscopeFromEye * point).xyz;
    vec2 place = own.xy * there.xy / max(there.z, LEAST_Z) + own.zw - 0.5;
    float arrives = exp(-between(smoke, scaled(place, smoke, ownSize)).r * depth / airlight.w);
    isValid = isValid && arrives > MIN_TRANSMISSION;
    steady = (steady - airlight.rgb) / max(arrives, MIN_TRANSMISSION) + airlight.rgb;
  }
  vec3 there = (lampFromEye * point).xyz;
  float cosine = log(max(there.z / max(length(there), 1e-9), exp(LEAST_LOG_COSINE)));
  vec3 light = gains * exp(vignetting.x * cosine - vignetting.y);
  isValid = isValid && min(light.r, min(light.g, light.b)) > MIN_LIGHT;
  steady /= max(light, vec3(MIN_LIGHT));
  vec3 levels = floor(clamp(steady, 0.0, 1.0) * 255.0 + 0.5);
  grey = vec4(floor(dot(levels, vec3(0.299, 0.587, 0.114)) + 0.5) / 255.0);
  missed = isValid ? vec4(clamp(steady - texelFetch(shown, at, 0).rgb, -1.0, 1.0), 1.0) : vec4(0.0);
}`;

/** Whether a pixel and those about it are valid. */
export const INNER = `${TOOLS}
uniform sampler2D missed;
layout(location = 0) out vec4 inner;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), last = textureSize(missed, 0) - 1;
  float least = 1.0;
  for (int y = -1; y <= 1; y++) {
    for (int x = -1; x <= 1; x++) least = min(least, texelFetch(missed, clamp(at + ivec2(x, y), ivec2(0), last), 0).a);
  }
  inner = vec4(least);
}`;

/** What is missed, fading towards what is not valid; and its validity. */
export const FADED = `${TOOLS}
uniform sampler2D missed, inner;
layout(location = 0) out vec4 faded;
const int REACH = 2;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), size = textureSize(missed, 0);
  float sum = 0.0;
  for (int y = -REACH; y <= REACH; y++) {
    for (int x = -REACH; x <= REACH; x++) {
      sum += texelFetch(inner, ivec2(mirrored(at.x + x, size.x), mirrored(at.y + y, size.y)), 0).r;
    }
  }
  float valid = max(2.0 * sum / 25.0 - 1.0, 0.0) * texelFetch(inner, at, 0).r;
  faded = vec4(texelFetch(missed, at, 0).rgb * valid, valid);
}`;

/** Sums of squares over blocks of the picture, of what is missed and of validity. */
export const POWER = `${HEAD}
uniform sampler2D faded;
layout(location = 0) out vec4 sums;
void main() {
  ivec2 size = textureSize(faded, 0), at = ivec2(gl_FragCoord.xy);
  ivec2 first = size * at / ${SUMMED}, end = size * (at + 1) / ${SUMMED};
  sums = vec4(0.0);
  for (int y = first.y; y < end.y; y++) {
    for (int x = first.x; x < end.x; x++) {
      vec4 each = texelFetch(faded, ivec2(x, y), 0);
      sums.xy += vec2(dot(each.rgb, each.rgb), each.a * each.a);
    }
  }
}`;

/** The share of a residual that is more than noise. */
export const ABOVE_NOISE = `${HEAD}
uniform sampler2D sums;
flat out float scale;
const float NOISE = 1.75 / 255.0;
void main() {
  gl_Position = vec4(vec2((gl_VertexID << 1) & 2, gl_VertexID & 2) * 2.0 - 1.0, 0.0, 1.0);
  vec2 total = vec2(0.0);
  for (int y = 0; y < ${SUMMED}; y++) for (int x = 0; x < ${SUMMED}; x++) total += texelFetch(sums, ivec2(x, y), 0).xy;
  scale = clamp(total.x / max(3.0 * total.y, 1.0) / (NOISE * NOISE) - 1.0, 0.0, 1.0);
}`;

export const RESIDUAL = `${TOOLS}
uniform sampler2D faded, known, shade;
flat in float scale;
layout(location = 0) out vec4 residual;         // red, green, blue times validity, validity
layout(location = 1) out vec4 depth;
layout(location = 2) out vec4 grey;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  residual = texelFetch(faded, at, 0) * vec4(vec3(scale), 1.0);
  depth = vec4(solidDepth(texelFetch(known, at, 0)));
  grey = texelFetch(shade, at, 0);
}`;

/** A recorded picture's grey as CARRY takes it: times validity, and validity. */
export const VALID_GREY = `${HEAD}
uniform sampler2D residual, grey;
layout(location = 0) out vec4 valid;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float share = texelFetch(residual, at, 0).a;
  valid = vec4(texelFetch(grey, at, 0).r * share, 0.0, 0.0, share);
}`;

/** Two grey pictures, the second as the model moves it to the first; and whether both show a place. First row first. */
export const PAIR = `${HEAD}
uniform sampler2D residual, grey, carried;
layout(location = 0) out vec4 pair;
const float MIN_SEEN = 0.3;
void main() {
  ivec2 at = ivec2(int(gl_FragCoord.x), textureSize(grey, 0).y - 1 - int(gl_FragCoord.y));
  vec4 second = texelFetch(carried, at, 0);
  float first = texelFetch(grey, at, 0).r;
  bool isSeen = second.a > MIN_SEEN && texelFetch(residual, at, 0).a > MIN_SEEN;
  pair = vec4(first, isSeen ? second.r / max(second.a, MIN_SEEN) : first, isSeen ? 1.0 : 0.0, 1.0);
}`;

/** The view's depth in the middles of its cells. */
export const COARSE = `${TOOLS}
uniform sampler2D known;
layout(location = 0) out vec4 depth;
void main() {
  ivec2 last = textureSize(known, 0) - 1, pixel = min(ivec2(gl_FragCoord.xy) * ${CELL_PX} + ${CELL_PX / 2}, last);
  depth = vec4(solidDepth(texelFetch(known, ivec2(pixel.x, last.y - pixel.y), 0)));
}`;

/** The motion of a Gaussian to two other times, in the cell of the view that shows its centre. */
export const GATHER = `${TOOLS}
uniform sampler2D now, before, after, known;    // mean, opacity; the view's depth
uniform mat4 cameraFromWorld;
uniform vec4 lens;
uniform ivec2 cells;
flat out vec4 toBefore, toAfter;
const float SHOWN = 0.05;
void main() {
  ivec2 at = ivec2(gl_VertexID % ${ROW}, gl_VertexID / ${ROW}), size = textureSize(known, 0);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = 1.0;
  toBefore = toAfter = vec4(0.0);
  vec4 p = texelFetch(now, at, 0);
  vec3 m = (cameraFromWorld * vec4(p.xyz, 1.0)).xyz;
  if (m.z < LEAST_Z) return;
  vec2 place = lens.xy * m.xy / m.z + lens.zw;
  if (any(lessThan(place, vec2(0.0))) || any(greaterThanEqual(place, vec2(size)))) return;
  ivec2 pixel = ivec2(place);
  float depth = solidDepth(texelFetch(known, ivec2(pixel.x, size.y - 1 - pixel.y), 0));
  if (abs(m.z - depth) > SHOWN * m.z) return;
  gl_Position = vec4((vec2(pixel * cells / size) + 0.5) / vec2(cells) * 2.0 - 1.0, 0.0, 1.0);
  toBefore = p.w * vec4(texelFetch(before, at, 0).xyz - p.xyz, 1.0);
  toAfter = p.w * vec4(texelFetch(after, at, 0).xyz - p.xyz, 1.0);
}`;

export const GATHERED = `${HEAD}
flat in vec4 toBefore, toAfter;
layout(location = 0) out vec4 before;
layout(location = 1) out vec4 after;
void main() {
  before = toBefore;
  after = toAfter;
}`;

const BLUR = `${TOOLS}
const float NEAR = 0.7, FAR = 6.0, LITTLE = 0.02;
const int NEAR_REACH = 3, FAR_REACH = 24;
vec4 blurred(sampler2D from, ivec2 along, float deviation, int reach) {
  ivec2 at = ivec2(gl_FragCoord.xy), size = textureSize(from, 0);
  vec4 sum = vec4(0.0);
  float total = 0.0;
  for (int i = -reach; i <= reach; i++) {
    float weight = exp(-0.5 * float(i * i) / (deviation * deviation));
    ivec2 place = at + i * along;
    sum += weight * texelFetch(from, ivec2(mirrored(place.x, size.x), mirrored(place.y, size.y)), 0);
    total += weight;
  }
  return sum / total;
}
`;

/** Sums of motion in cells, blurred along rows: a little, and far. */
export const BLUR_ROWS = `${BLUR}
uniform sampler2D before, after;
layout(location = 0) out vec4 nearBefore;
layout(location = 1) out vec4 nearAfter;
layout(location = 2) out vec4 farBefore;
layout(location = 3) out vec4 farAfter;
void main() {
  nearBefore = blurred(before, ivec2(1, 0), NEAR, NEAR_REACH);
  nearAfter = blurred(after, ivec2(1, 0), NEAR, NEAR_REACH);
  farBefore = blurred(before, ivec2(1, 0), FAR, FAR_REACH);
  farAfter = blurred(after, ivec2(1, 0), FAR, FAR_REACH);
}`;

/** Then down columns: the mean motion of each cell, world axes. */
export const BLUR_COLUMNS = `${BLUR}
uniform sampler2D nearBefore, nearAfter, farBefore, farAfter;
layout(location = 0) out vec4 before;
layout(location = 1) out vec4 after;
vec4 mean(sampler2D near, sampler2D far) {
  vec4 sum = blurred(near, ivec2(0, 1), NEAR, NEAR_REACH) + LITTLE * blurred(far, ivec2(0, 1), FAR, FAR_REACH);
  return vec4(sum.xyz / max(sum.w, 1e-9), 1.0);
}
void main() {
  before = mean(nearBefore, farBefore);
  after = mean(nearAfter, farAfter);
}`;

/** The motion to two frames, after which their pictures show the same where they meet: the flow between them is shared. */
export const CORRECT = `${TOOLS}
uniform sampler2D movedBefore, movedAfter, weights, flow;   // weights: the fourth is the view's depth
uniform mat4 beforeFromView, afterFromView, beforeFromWorld, afterFromWorld;
uniform vec4 lens, eyeLens;
uniform vec2 size, eyeSize;
uniform float share;                            // of the second frame
layout(location = 0) out vec4 before;
layout(location = 1) out vec4 after;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec2 pixel = min(vec2(at * ${CELL_PX} + ${CELL_PX / 2}), size - 1.0) + 0.5;
  vec4 point = vec4(texelFetch(weights, at, 0).w * vec3((pixel - lens.zw) / lens.xy, 1.0), 1.0);
  vec3 toBefore = texelFetch(movedBefore, at, 0).xyz, toAfter = texelFetch(movedAfter, at, 0).xyz;
  vec3 seen = (beforeFromView * point).xyz, there = seen + mat3(beforeFromWorld) * toBefore;
  vec2 place = eyeLens.xy * there.xy / max(there.z, LEAST_Z) + eyeLens.zw - 0.5;
  vec2 apart = between(flow, scaled(place, flow, eyeSize)).xy;
  vec3 first = vec3(-share * apart * seen.z / eyeLens.xy, 0.0);
  vec3 second = vec3((1.0 - share) * apart * (afterFromView * point).z / eyeLens.xy, 0.0);
  before = vec4(toBefore + transpose(mat3(beforeFromWorld)) * first, 1.0);
  after = vec4(toAfter + transpose(mat3(afterFromWorld)) * second, 1.0);
}`;

/** An eye's residuals of two frames where the points of the view were then: red, green, blue times weight, and weight. */
export const CARRY = `${TOOLS}
uniform sampler2D known;
uniform sampler2D residualBefore, depthBefore, movedBefore, residualAfter, depthAfter, movedAfter;
uniform mat4 beforeFromView, afterFromView, beforeFromWorld, afterFromWorld;
uniform vec4 lens, eyeLens;
uniform vec2 weights;
layout(location = 0) out vec4 total;
const float MAX_ERROR = 0.06;
vec4 residualAt(sampler2D from, ivec2 at, ivec2 size) {
  bool isInside = at.x >= 0 && at.y >= 0 && at.x < size.x && at.y < size.y;
  return isInside ? texelFetch(from, ivec2(at.x, size.y - 1 - at.y), 0) : vec4(0.0);
}
float depthAt(sampler2D from, ivec2 at, ivec2 size) {
  ivec2 inside = clamp(at, ivec2(0), size - 1);
  return texelFetch(from, ivec2(inside.x, size.y - 1 - inside.y), 0).r;
}
vec4 carried(vec3 point, mat4 eyeFromView, sampler2D residual, sampler2D depth, vec3 moved) {
  vec3 there = (eyeFromView * vec4(point, 1.0)).xyz + moved;
  if (there.z < LEAST_Z) return vec4(0.0);
  ivec2 size = textureSize(residual, 0);
  vec2 place = eyeLens.xy * there.xy / there.z + eyeLens.zw - 0.5;
  if (!(all(greaterThanEqual(place, vec2(-0.5))) && all(lessThan(place, vec2(size) - 0.5)))) return vec4(0.0);
  ivec2 a = ivec2(floor(place));
  vec2 f = place - vec2(a);
  ivec2 b = a + ivec2(1, 0), c = a + ivec2(0, 1), d = a + 1;
  float above = mix(depthAt(depth, a, size), depthAt(depth, b, size), f.x);
  float apart = (there.z - mix(above, mix(depthAt(depth, c, size), depthAt(depth, d, size), f.x), f.y)) / there.z / MAX_ERROR;
  float near = 1.0 - apart * apart;
  if (near <= 0.0) return vec4(0.0);
  vec4 upper = mix(residualAt(residual, a, size), residualAt(residual, b, size), f.x);
  return near * near * mix(upper, mix(residualAt(residual, c, size), residualAt(residual, d, size), f.x), f.y);
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), size = textureSize(known, 0);
  total = vec4(0.0);
  float depth = solidDepth(texelFetch(known, at, 0));
  if (depth <= 0.0) return;
  vec2 pixel = vec2(at.x, size.y - 1 - at.y);
  vec3 point = depth * vec3((pixel + 0.5 - lens.zw) / lens.xy, 1.0);
  vec2 cell = scaled(pixel, movedBefore, vec2(size));
  if (weights.x > 0.0) {
    vec3 moved = mat3(beforeFromWorld) * between(movedBefore, cell).xyz;
    total += weights.x * carried(point, beforeFromView, residualBefore, depthBefore, moved);
  }
  if (weights.y > 0.0) {
    vec3 moved = mat3(afterFromWorld) * between(movedAfter, cell).xyz;
    total += weights.y * carried(point, afterFromView, residualAfter, depthAfter, moved);
  }
}`;

/** What the eyes have in common along a row, and how much there is. */
export const ALIKE = `${TOOLS}
uniform sampler2D left, right;
layout(location = 0) out vec4 sums;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  int width = textureSize(left, 0).x;
  sums = vec4(0.0);
  for (int i = -4; i <= 4; i++) {
    ivec2 place = ivec2(mirrored(at.x + i, width), at.y);
    vec4 l = texelFetch(left, place, 0), r = texelFetch(right, place, 0);
    sums.xy += l.a * r.a * vec2(dot(l.rgb, r.rgb), (dot(l.rgb, l.rgb) + dot(r.rgb, r.rgb)) / 2.0);
  }
}`;

/** What the view gets. eyes: 0: the left texture as it is; 1: weighted; 2: of both eyes together. */
export const TOGETHER = `${TOOLS}
uniform sampler2D left, right, sums, weights;   // weights: of what each eye misses alone, and of what both miss
uniform int eyes, isDimmed;
layout(location = 0) out vec4 added;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), size = textureSize(left, 0);
  vec4 l = texelFetch(left, at, 0);
  added = l;
  if (eyes == 0) return;
  vec3 weight = between(weights, scaled(vec2(at.x, size.y - 1 - at.y), weights, vec2(size))).xyz;
  added = l * weight.x;
  if (eyes == 1) return;
  vec4 r = texelFetch(right, at, 0);
  vec2 sum = vec2(0.0);
  for (int i = -4; i <= 4; i++) sum += texelFetch(sums, ivec2(at.x, mirrored(at.y + i, size.y)), 0).xy / 81.0;
  float correlation = clamp(sum.x / (sum.y + 1e-7), 0.0, 1.0), alike = 2.0 * correlation / (1.0 + correlation);
  vec3 both = alike * l.a * r.a / 2.0 * (l.rgb + r.rgb);
  float near = weight.x + weight.y, scale = 1.0 / max(near, 1.0);
  vec3 alone = scale * (weight.x * (l.rgb - both) + weight.y * (r.rgb - both));
  if (isDimmed == 1) alone = min(alone, 0.0);
  added = vec4(max(weight.z, min(near, 1.0)) * both + alone, 1.0);
}`;
