// What the GPU computes: the state of every Gaussian at a time, its ellipse on the image, the blend, and the hatch. The
// contract is intrasplat/splat/camera.py; the bounds are those of intrasplat/splat/constants.py.

/** Gaussians in a row of a texture. */
export const ROW = 512;
/** Texels in a row of the texture of motion numbers. */
export const NUMBERS_ROW = 4096;

export const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp isampler2D;
`;

/** One triangle over the whole target. */
export const EVERYWHERE = `${HEAD}
void main() {
  gl_Position = vec4(vec2((gl_VertexID << 1) & 2, gl_VertexID & 2) * 2.0 - 1.0, 0.0, 1.0);
}`;

/** One texel a Gaussian: at rest, plus its motion numbers times the patterns of the time. */
export const DEFORM = `${HEAD}
uniform sampler2D rest;      // 5 texels a Gaussian (pack.js)
uniform isampler2D numbers;  // channels x quads texels a Gaussian
uniform sampler2D patterns;  // channels x quads
uniform int count, channels, quads;
layout(location = 0) out vec4 place;   // mean, opacity
layout(location = 1) out vec4 turn;    // unit quaternion w, x, y, z
layout(location = 2) out vec4 size;    // standard deviations, what training saw
layout(location = 3) out vec4 colour;  // the constant harmonic's red, green, blue; gloss
const float MOST = 1048576.0;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  int n = at.y * ${ROW} + at.x;
  place = turn = size = colour = vec4(0.0);
  if (n >= count) return;
  vec4 s[5];
  for (int i = 0; i < 5; i++) s[i] = texelFetch(rest, ivec2(at.x * 5 + i, at.y), 0);
  float moved[14];
  for (int c = 0; c < 14; c++) {
    float sum = 0.0;
    if (c < channels) {
      for (int q = 0; q < quads; q++) {
        int k = (n * channels + c) * quads + q;
        vec4 number = vec4(texelFetch(numbers, ivec2(k % ${NUMBERS_ROW}, k / ${NUMBERS_ROW}), 0));
        sum += dot(number, texelFetch(patterns, ivec2(q, c), 0));
      }
    }
    moved[c] = sum * (c < 3 ? s[4].x : c < 10 ? s[4].y : s[4].z);
  }
  place = vec4(s[0].xyz + vec3(moved[0], moved[1], moved[2]), 1.0 / (1.0 + exp(-s[0].w)));
  turn = normalize(s[1] + vec4(moved[3], moved[4], moved[5], moved[6]));
  size = vec4(min(exp(s[2].xyz + vec3(moved[7], moved[8], moved[9])), vec3(MOST)), s[2].w);
  vec3 opponent = moved[10] * vec3(0.57735026919) + moved[11] * vec3(0.70710678119, 0.0, -0.70710678119)
    + moved[12] * vec3(0.40824829046, -0.81649658093, 0.40824829046);
  colour = vec4(s[3].rgb + opponent, s[3].w + moved[13]);
}`;

/** A parallelogram about each ellipse. Gaussians come nearest first. */
export const SPLAT = `${HEAD}
uniform sampler2D place, turn, size, colour, values;
uniform mat4 cameraFromWorld;
uniform vec4 lens;       // fx, fy, cx, cy
uniform vec2 picture;    // width, height
uniform vec2 shine;      // side, dim
uniform vec2 enlarged;   // by how much the focal lengths exceed the recording's; 0: nothing is enlarged
uniform vec4 recorded;   // the third row of the recording's camera_from_world
in uint gaussian;
flat out vec2 centre;
flat out vec4 conic;     // a, b, c, opacity
flat out vec3 rgb;
flat out vec2 depthAndValue;
const float NEAR = 0.2, MIN_ALPHA = 1.0 / 255.0, EPS2D = 0.3, MARGIN = 0.15, SH_C0 = 0.28209479177;
// The parallelogram is a little wider than the ellipse, against rounding; the cut is made on every pixel.
const float SLACK = 1.001, SLACK_PX = 0.01;
void main() {
  ivec2 at = ivec2(int(gaussian) % ${ROW}, int(gaussian) / ${ROW});
  vec4 p = texelFetch(place, at, 0), q = texelFetch(turn, at, 0);
  vec4 s = texelFetch(size, at, 0), c = texelFetch(colour, at, 0);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  centre = vec2(0.0);
  conic = vec4(0.0);
  rgb = vec3(0.0);
  depthAndValue = vec2(0.0);
  vec3 m = (cameraFromWorld * vec4(p.xyz, 1.0)).xyz;
  if (m.z <= NEAR || p.w < MIN_ALPHA) return;
  mat3 rotation = mat3(
    1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
    2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
    2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  mat3 axes = mat3(cameraFromWorld) * rotation;
  vec2 low = (-lens.zw - MARGIN * picture) / lens.xy, high = (picture - lens.zw + MARGIN * picture) / lens.xy;
  vec2 ratio = clamp(m.xy / m.z, low, high), slope = lens.xy / m.z;
  // k0 and k1 are the rows of J W R S; cov2d is their products, plus the low-pass of the recording's pixels.
  vec3 third = vec3(axes[0].z, axes[1].z, axes[2].z);
  vec3 k0 = slope.x * (vec3(axes[0].x, axes[1].x, axes[2].x) - ratio.x * third) * s.xyz;
  vec3 k1 = slope.y * (vec3(axes[0].y, axes[1].y, axes[2].y) - ratio.y * third) * s.xyz;
  float xx = dot(k0, k0), yy = dot(k1, k1), xy = dot(k0, k1);
  vec3 area = cross(k0, k1);
  vec2 grown = max(vec2(1.0), enlarged * dot(recorded, vec4(p.xyz, 1.0)) / m.z), low_pass = EPS2D * grown * grown;
  // Sums of squares: the difference xx yy - xy xy loses its digits where a Gaussian is long and thin.
  float det = dot(area, area) + low_pass.y * xx + low_pass.x * yy + low_pass.x * low_pass.y;
  xx += low_pass.x;
  yy += low_pass.y;
  centre = slope * m.xy + lens.zw;
  conic = vec4(yy / det, -xy / det, xx / det, p.w);
  float gloss = shine.x * c.w - shine.y * abs(c.w);
  rgb = max(vec3(0.0), 0.5 + SH_C0 * c.rgb + gloss);
  depthAndValue = vec2(m.z, texelFetch(values, at, 0).r);
  float radius = sqrt(2.0 * log(p.w / MIN_ALPHA)) * SLACK;
  vec2 corner = vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID >> 1) * 2 - 1) * radius;
  float wide = sqrt(xx), tall = sqrt(det / xx);
  vec2 reach = vec2(wide * corner.x, xy / wide * corner.x + tall * corner.y) + sign(corner) * SLACK_PX;
  gl_Position = vec4((centre + reach) / picture * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 0.0, 1.0);
}`;

/** Blended front to back: colour and T, then depth, value and T. The target's alpha is T, 1 at first. */
export const BLEND = `${HEAD}
uniform vec2 picture;
flat in vec2 centre;
flat in vec4 conic;
flat in vec3 rgb;
flat in vec2 depthAndValue;
layout(location = 0) out vec4 shown;
layout(location = 1) out vec4 known;
const float MIN_ALPHA = 1.0 / 255.0, MAX_ALPHA = 0.99;
void main() {
  vec2 d = vec2(gl_FragCoord.x, picture.y - gl_FragCoord.y) - centre;
  float power = -0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) - conic.y * d.x * d.y;
  float alpha = conic.w * exp(power);
  if (alpha < MIN_ALPHA) discard;
  alpha = min(alpha, MAX_ALPHA);
  shown = vec4(rgb * alpha, alpha);
  known = vec4(depthAndValue * alpha, 0.0, alpha);
}`;

/** Whether a pixel shows nothing solid, or mostly what no frame saw; and whether what it shows is hardly trusted. */
export const MISSING = `${HEAD}
uniform sampler2D known;
uniform bool isKnown;
layout(location = 0) out vec4 found;
const float COVERED = 0.5, LOW_TRUST = 0.1;
void main() {
  vec4 k = texelFetch(known, ivec2(gl_FragCoord.xy), 0);
  float alpha = 1.0 - k.a;
  bool isSolid = alpha >= COVERED, isSeen = !isKnown || k.g >= 0.0;
  float trust = isKnown && isSolid ? clamp(k.g / alpha, 0.0, 1.0) : 0.0;
  found = vec4(isSolid && isSeen ? 0.0 : 1.0, trust < LOW_TRUST ? 1.0 : 0.0, 0.0, 1.0);
}`;

/** Along a row: the share of missing pixels around. Borders are mirrored, as OpenCV's blur does. */
export const ALONG = `${HEAD}
uniform sampler2D found;
uniform int reach;
layout(location = 0) out vec4 share;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  int last = textureSize(found, 0).x - 1, count = 0;
  for (int i = -reach; i <= reach; i++) {
    int x = abs(at.x + i);
    count += texelFetch(found, ivec2(x > last ? 2 * last - x : x, at.y), 0).r > 0.5 ? 1 : 0;
  }
  share = vec4(float(count) / 255.0, texelFetch(found, at, 0).g, 0.0, 1.0);
}`;

/** Down a column: what most pixels around are decides. Then the picture, with its hatch if unseen is marked. */
export const SHOW = `${HEAD}
uniform sampler2D shown, along, added;
uniform int reach, stripe;
uniform bool isMarked, isAdded;
layout(location = 0) out vec4 picture;
layout(location = 1) out vec4 told;    // unseen, hardly trusted
const float DARK = 40.0 / 255.0, LIGHT = 74.0 / 255.0;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), size = textureSize(along, 0);
  int last = size.y - 1, count = 0, side = 2 * reach + 1;
  for (int i = -reach; i <= reach; i++) {
    int y = abs(at.y + i);
    count += int(texelFetch(along, ivec2(at.x, y > last ? 2 * last - y : y), 0).r * 255.0 + 0.5);
  }
  bool isUnseen = 2 * count > side * side;
  vec3 rgb = texelFetch(shown, at, 0).rgb;
  if (isAdded) rgb += texelFetch(added, at, 0).rgb;
  rgb = clamp(rgb, 0.0, 1.0);
  if (isUnseen && isMarked) rgb = vec3(((last - at.y + at.x) / stripe) % 2 == 1 ? LIGHT : DARK);
  picture = vec4(rgb, 1.0);
  told = vec4(isUnseen ? 1.0 : 0.0, isUnseen ? 0.0 : texelFetch(along, at, 0).g, 0.0, 1.0);
}`;

/** Sums of both shares over blocks of the picture, SUMS x SUMS of them. */
export const SUMS = 32;
export const ADD = `${HEAD}
uniform sampler2D told;
layout(location = 0) out vec4 sums;
void main() {
  ivec2 size = textureSize(told, 0), at = ivec2(gl_FragCoord.xy);
  ivec2 first = size * at / ${SUMS}, end = size * (at + 1) / ${SUMS};
  sums = vec4(0.0);
  for (int y = first.y; y < end.y; y++) {
    for (int x = first.x; x < end.x; x++) sums += texelFetch(told, ivec2(x, y), 0);
  }
}`;
