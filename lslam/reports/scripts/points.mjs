// Points drawn by WebGL.
import { ramp } from "./colours.mjs";
import { unpack } from "./numbers.mjs";

const VERTEX = `attribute vec3 q; attribute float shade; uniform vec3 low; uniform vec3 quantum; uniform mat4 M;
uniform float size; varying float v;
void main() { v = shade; gl_Position = M * vec4(low + quantum * q, 1.0); gl_PointSize = clamp(size / gl_Position.w, 1.0, 24.0); }`;
const FRAGMENT = `precision mediump float; uniform sampler2D colours; varying float v;
void main() { gl_FragColor = texture2D(colours, vec2((v * 255.0 + 0.5) / 256.0, 0.5)); }`;

/** A program that draws the points of the cloud on `canvas`; null where that cannot be. */
export function pointDrawer(canvas, cloud) {
  const gl = canvas.getContext("webgl", { antialias: false, alpha: true });
  if (!gl) return null;
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  const at = (name) => gl.getUniformLocation(program, name);
  const uniforms = { low: at("low"), quantum: at("quantum"), M: at("M"), size: at("size") };
  const buffers = {};
  const fill = (name, array, size, kind, isShare) => {
    buffers[name] = buffers[name] || gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    const place = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, kind, isShare, 0, 0);
  };
  fill("q", unpack(cloud.points, Int16Array), 3, gl.SHORT, false);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, ramp(cloud.colours));
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.enable(gl.DEPTH_TEST);
  return {
    shade: (values) => fill("shade", values, 1, gl.UNSIGNED_BYTE, true),
    draw: (M, centre, size) => {
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.uniform3fv(uniforms.low, cloud.low.map((value, k) => value + 32768 * cloud.step[k] - centre[k]));
      gl.uniform3fv(uniforms.quantum, cloud.step);
      gl.uniformMatrix4fv(uniforms.M, false, M);
      gl.uniform1f(uniforms.size, size);
      gl.drawArrays(gl.POINTS, 0, cloud.count);
    },
  };
}
