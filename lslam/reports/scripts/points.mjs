// Points and lines drawn by WebGL 2: points are round, sized by distance, shaded by the depth about them; lines hide behind them.
// Eye-dome lighting: Boucheny, "Interactive scientific visualization of large datasets", 2009.
import { BY, ramp } from "./colours.mjs";

const POINT_VERTEX = `#version 300 es
in vec3 q; in float value; in vec3 rgb; uniform vec3 low; uniform vec3 quantum; uniform mat4 M; uniform float size; uniform float least;
uniform int by; uniform vec2 range; uniform vec3 flat_tint; uniform sampler2D colours; out vec3 tint; flat out int is_round;
void main() {
  vec3 p = low + quantum * q;
  gl_Position = M * vec4(p, 1.0);
  gl_PointSize = clamp(size / gl_Position.w, least, 64.0);
  is_round = int(gl_PointSize > 3.0); // of fewer pixels a circle leaves none
  float share = ((by == 0 ? p.z : value) - range.x) / (range.y - range.x);
  tint = by == 2 ? rgb : by == 3 ? flat_tint : texture(colours, vec2((clamp(share, 0.0, 1.0) * 255.0 + 0.5) / 256.0, 0.5)).rgb;
}`;
const POINT_FRAGMENT = `#version 300 es
precision mediump float; in vec3 tint; flat in int is_round; out vec4 colour;
void main() {
  vec2 off = 2.0 * gl_PointCoord - 1.0;
  if (is_round == 1 && dot(off, off) > 1.0) discard;
  colour = vec4(tint, 1.0);
}`;
const WHOLE_VERTEX = `#version 300 es
void main() { gl_Position = vec4(4.0 * float(gl_VertexID / 2) - 1.0, 4.0 * float(gl_VertexID % 2) - 1.0, 0.0, 1.0); }`;
const DOME_FRAGMENT = `#version 300 es
precision highp float; uniform sampler2D seen; uniform sampler2D depths; uniform vec4 lens; uniform float strength; uniform vec2 reach;
out vec4 colour;
float away(vec2 at) {
  float ndc = 2.0 * texture(depths, at * reach).r - 1.0;
  return ndc < 1.0 ? max(lens.w - (ndc - lens.y) / (lens.x + lens.z * ndc), 1e-3) : 1e9;
}
void main() {
  vec2 at = gl_FragCoord.xy;
  float here = away(at);
  if (here > 1e8) { colour = vec4(0.0); return; }
  vec4 about = vec4(away(at + vec2(1, 0)), away(at - vec2(1, 0)), away(at + vec2(0, 1)), away(at - vec2(0, 1)));
  float nearer = dot(max(1.0 - about / here, 0.0), vec4(1.0));
  colour = vec4(texture(seen, at * reach).rgb * max(exp(-strength * nearer), 0.25), 1.0);
}`;
const LINE_VERTEX = `#version 300 es
in vec3 a; in vec3 b; uniform vec3 centre; uniform mat4 M; uniform vec2 half_size; uniform float width;
void main() {
  vec4 p = M * vec4(a - centre, 1.0);
  vec4 q = M * vec4(b - centre, 1.0);
  if (isnan(p.x + q.x) || max(p.w, q.w) < 0.02) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (p.w < 0.02) p = mix(p, q, (0.02 - p.w) / (q.w - p.w));
  if (q.w < 0.02) q = mix(q, p, (0.02 - q.w) / (p.w - q.w));
  vec2 from = p.xy / p.w * half_size;
  vec2 along = q.xy / q.w * half_size - from;
  along = length(along) > 1e-4 ? normalize(along) : vec2(1.0, 0.0);
  bool is_end = gl_VertexID / 2 == 1;
  vec4 end = is_end ? q : p;
  vec2 off = vec2(-along.y, along.x) * (float(gl_VertexID % 2) - 0.5) * width + along * (is_end ? 0.25 : -0.25) * width;
  gl_Position = vec4(end.xy / end.w + off / half_size, end.z / end.w, 1.0);
}`;
const LINE_FRAGMENT = `#version 300 es
precision highp float; uniform sampler2D depths; uniform vec4 tint; uniform float hidden; out vec4 colour;
void main() {
  bool is_hidden = gl_FragCoord.z > texelFetch(depths, ivec2(gl_FragCoord.xy), 0).r;
  colour = tint * (is_hidden ? hidden : 1.0);
}`;

/** Program of two shaders with its uniforms by name; null where the shaders do not compile. */
function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  const found = { program };
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i += 1) {
    const { name } = gl.getActiveUniform(program, i);
    found[name] = gl.getUniformLocation(program, name);
  }
  return found;
}

export class PointDrawer {
  /** The drawer of a canvas; null where WebGL 2 is missing. */
  static on(canvas, colours) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: true });
    if (!gl) return null;
    const programs = [[POINT_VERTEX, POINT_FRAGMENT], [WHOLE_VERTEX, DOME_FRAGMENT], [LINE_VERTEX, LINE_FRAGMENT]].map((pair) => programOf(gl, ...pair));
    return programs.every(Boolean) ? new PointDrawer(gl, programs, colours) : null;
  }

  constructor(gl, [points, dome, line], colours) {
    [this.gl, this.points, this.dome, this.line] = [gl, points, dome, line];
    this.clouds = new Map();
    this.buffers = new WeakMap();
    this.empty = gl.createVertexArray();
    this.palette = this.texture(() => gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, ramp(colours)));
    this.frame = gl.createFramebuffer();
  }

  texture(fill) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    fill();
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
    for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Draw a cloud from now on: { points, low, step, count }, and as it is coloured `value` or `rgb`, bytes per point. */
  add(name, cloud) {
    this.remove(name);
    const { gl } = this;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const held = { cloud, array, buffers: {} };
    this.clouds.set(name, held);
    this.fill(held, "q", cloud.points, 3, gl.SHORT, false);
    if (cloud.value) this.fill(held, "value", cloud.value, 1, gl.UNSIGNED_BYTE, true);
    if (cloud.rgb) this.fill(held, "rgb", cloud.rgb, 3, gl.UNSIGNED_BYTE, true);
  }

  /** Give the points of a cloud other values (bytes) or colours (3 bytes each). */
  recolour(name, kind, array) {
    const held = this.clouds.get(name);
    this.gl.bindVertexArray(held.array);
    this.fill(held, kind, array, kind === "rgb" ? 3 : 1, this.gl.UNSIGNED_BYTE, true);
  }

  remove(name) {
    const held = this.clouds.get(name);
    if (!held) return;
    for (const buffer of Object.values(held.buffers)) this.gl.deleteBuffer(buffer);
    this.gl.deleteVertexArray(held.array);
    this.clouds.delete(name);
  }

  fill(held, name, array, size, kind, isShare) {
    const { gl } = this;
    const place = gl.getAttribLocation(this.points.program, name);
    held.buffers[name] ||= gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, held.buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    if (place < 0) return;
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, kind, isShare, 0, 0);
  }

  /** Textures as large as the canvas, for colours and depths. */
  resize() {
    const { gl } = this;
    const { width, height } = gl.canvas;
    if (this.size?.[0] === width && this.size[1] === height) return;
    this.size = [width, height];
    for (const old of [this.seen, this.depths]) gl.deleteTexture(old || null);
    this.seen = this.texture(() => gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null));
    this.depths = this.texture(() => gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.seen, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.depths, 0);
  }

  /**
   * One picture. view: { M, depth, rest, perspective, away } of the camera, `centre`, m; size, least: px of a point at the centre, and
   * of any; by, range: how points are coloured; from, to: share of each cloud that is there already, and will be; strength: of
   * the shading; names: clouds that are seen; lines: [{ points, tint, width, hidden, isPairs }].
   */
  draw({ view, centre, size, least, by, range, from, to, strength, ratio, names, lines }) {
    const { gl } = this;
    this.resize();
    gl.viewport(0, 0, ...this.size);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.clearColor(0, 0, 0, 0);
    if (from === 0) gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.useProgram(this.points.program);
    gl.bindTexture(gl.TEXTURE_2D, this.palette);
    gl.uniformMatrix4fv(this.points.M, false, view.M);
    gl.uniform1f(this.points.size, size);
    gl.uniform1f(this.points.least, least);
    for (const name of names) this.drawCloud(this.clouds.get(name), centre, by, range, from, to);
    gl.disable(gl.DEPTH_TEST);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    if (strength > 0) this.drawDome(view, strength);
    else gl.blitFramebuffer(0, 0, ...this.size, 0, 0, ...this.size, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.line.program);
    gl.uniformMatrix4fv(this.line.M, false, view.M);
    gl.uniform3fv(this.line.centre, centre);
    gl.uniform2f(this.line.half_size, this.size[0] / 2, this.size[1] / 2);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.depths);
    for (const line of lines) this.drawLine(line, ratio);
    gl.bindVertexArray(null);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  /** Whether the last picture is there. */
  isDone() {
    const { gl, fence } = this;
    if (!fence) return true;
    if (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED && !gl.isContextLost()) return false;
    gl.deleteSync(fence);
    this.fence = null;
    return true;
  }

  drawCloud({ cloud, array }, centre, by, range, from, to) {
    const { gl, points } = this;
    const how = cloud.tint ? BY.one : by;
    gl.bindVertexArray(array);
    gl.uniform1i(points.by, how);
    gl.uniform3fv(points.flat_tint, cloud.tint || [0, 0, 0]);
    gl.uniform3fv(points.low, cloud.low.map((low, k) => low + 32768 * cloud.step[k] - centre[k]));
    gl.uniform3fv(points.quantum, cloud.step);
    gl.uniform2fv(points.range, how === BY.height ? range.map((z) => z - centre[2]) : range);
    const first = Math.ceil(from * cloud.count);
    gl.drawArrays(gl.POINTS, first, Math.ceil(to * cloud.count) - first);
  }

  drawDome({ depth, rest, perspective, away }, strength) {
    const { gl, dome } = this;
    gl.useProgram(dome.program);
    gl.bindVertexArray(this.empty);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.depths);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.seen);
    gl.uniform1i(dome.depths, 1);
    gl.uniform4f(dome.lens, depth, rest, perspective, away);
    gl.uniform1f(dome.strength, strength);
    gl.uniform2f(dome.reach, 1 / this.size[0], 1 / this.size[1]);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  drawLine({ points, tint, width, hidden, isPairs }, ratio) {
    const { gl, line } = this;
    const legs = isPairs ? points.length / 6 : points.length / 3 - 1;
    if (legs < 1) return;
    if (!this.buffers.has(points)) this.buffers.set(points, this.lineBuffer(points, isPairs ? 24 : 12));
    gl.bindVertexArray(this.buffers.get(points));
    gl.uniform1f(line.width, width * ratio);
    gl.uniform4fv(line.tint, tint);
    gl.uniform1f(line.hidden, hidden);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, legs);
  }

  lineBuffer(points, stride) {
    const { gl, line } = this;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, points, gl.STATIC_DRAW);
    for (const [name, offset] of [["a", 0], ["b", 12]]) {
      const place = gl.getAttribLocation(line.program, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, stride, offset);
      gl.vertexAttribDivisor(place, 1);
    }
    return array;
  }
}
