// Textures, targets and programs of WebGL2.

/** This browser cannot draw the scene. */
export class CannotDrawError extends Error {
  /**
   * @param {string} message
   * @param {"kind"|"no_floats"|"too_large"|"no_worker"|"no_codec"|"context_lost"|"closed"|"outdated"} code
   */
  constructor(message, code) {
    super(message);
    this.code = code;
  }
}

/** Data and zeros, so many numbers. */
export function padded(data, length) {
  if (data.length === length) return data;
  const wide = new data.constructor(length);
  wide.set(data);
  return wide;
}

/** @returns {WebGLTexture} of which single texels are read */
export function texture(gl, internal, width, height, format, type, data) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
  for (const each of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, each, gl.NEAREST);
  return made;
}

/** @returns {WebGLFramebuffer} to draw into textures */
export function target(gl, textures) {
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  const places = textures.map((each, i) => {
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, each, 0);
    return gl.COLOR_ATTACHMENT0 + i;
  });
  gl.drawBuffers(places);
  if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) {
    throw new CannotDrawError("This GPU has no memory or no format for the picture.", "too_large");
  }
  return made;
}

/** Run the program in use for all its pixels. */
export function fillTarget(gl, frame, width, height) {
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.viewport(0, 0, width, height);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
}

/** A program; use() binds textures and sets uniforms by name. */
export function linked(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    throw new CannotDrawError(`A program of the page does not compile here. ${logs.join(" ")}`, "no_floats");
  }
  const places = new Map();
  const placeOf = (name) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
    return places.get(name);
  };
  return {
    attribute: (name) => gl.getAttribLocation(program, name),
    use(textures, uniforms) {
      gl.useProgram(program);
      Object.entries(textures).forEach(([name, each], unit) => {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, each);
        gl.uniform1i(placeOf(name), unit);
      });
      gl.activeTexture(gl.TEXTURE0 + 15); // where textures are filled, so that none in use is replaced
      for (const [name, [kind, ...values]] of Object.entries(uniforms)) gl[`uniform${kind}`](placeOf(name), ...values);
    },
  };
}

/** A uniform of a matrix's first three rows. @param {number[][]} rows */
export function matrix(rows) {
  const columns = [0, 1, 2, 3].flatMap((j) => [...rows.slice(0, 3).map((row) => row[j]), j === 3 ? 1 : 0]);
  return ["Matrix4fv", false, new Float32Array(columns)];
}
