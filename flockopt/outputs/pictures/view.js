"use strict";
// Drawing in WebGL 2: small column-major matrices, meshes, and three programs for solids, lines and points.

function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++)
    for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));
const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);

function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2), d = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, 2 * far * near / d, 0]);
}

function lookAt(eye, right, up, back) {
  return new Float32Array([right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot(right, eye), -dot(up, eye), -dot(back, eye), 1]);
}

// ---- Meshes: flat arrays of position, normal, colour; nine numbers a vertex -------------------------------

class Mesh {
  constructor() { this.numbers = []; }

  quad(a, b, c, d, color, normal) {
    const n = normal || unit(cross(subtract(b, a), subtract(d, a)));
    for (const p of [a, b, c, a, c, d]) this.numbers.push(...p, ...n, ...color);
  }

  // A prism over a footprint that turns anticlockwise; smooth sides where it stands for a cylinder.
  prism(footprint, low, high, color, axis) {
    const n = footprint.length, mean = [0, 1].map((k) => footprint.reduce((sum, p) => sum + p[k], 0) / n);
    const out = (p) => unit([p[0] - mean[0], p[1] - mean[1], 0]);
    for (let i = 0; i < n; i++) {
      const p = footprint[i], q = footprint[(i + 1) % n];
      const corners = [[...p, low], [...q, low], [...q, high], [...p, high]];
      if (!axis) this.quad(...corners, color);
      else for (const k of [0, 1, 2, 0, 2, 3]) this.numbers.push(...corners[k], ...out(corners[k]), ...color);
      for (const [z, up] of [[high, 1], [low, -1]])
        for (const v of [[...mean, z], [...p, z], [...q, z]]) this.numbers.push(...v, 0, 0, up, ...color);
    }
  }

  sphere(center, radius, color, steps = 20) {
    const at = (i, j) => {
      const a = 2 * Math.PI * i / steps, b = Math.PI * (j / (steps / 2) - 0.5);
      return [Math.cos(a) * Math.cos(b), Math.sin(a) * Math.cos(b), Math.sin(b)];
    };
    for (let i = 0; i < steps; i++) for (let j = 0; j < steps / 2; j++)
      for (const [u, v] of [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]) {
        const n = at(i + u, j + v);
        this.numbers.push(...center.map((c, k) => c + radius * n[k]), ...n, ...color);
      }
  }
}

const circle = (x, y, radius, steps) => Array.from({ length: steps }, (_, i) => {
  const a = 2 * Math.PI * i / steps;
  return [x + radius * Math.cos(a), y + radius * Math.sin(a)];
});

function footprint(obstacle) {
  const [x, y] = obstacle.center;
  if (obstacle.shape !== "box") return circle(x, y, obstacle.radius, 40);
  const c = Math.cos(obstacle.yaw), s = Math.sin(obstacle.yaw), [a, b] = obstacle.size.map((side) => side / 2);
  return [[-a, -b], [a, -b], [a, b], [-a, b]].map(([u, v]) => [x + c * u - s * v, y + s * u + c * v]);
}

// A quadrotor of radius 1: a body, two arms, four rotors. White where it takes its drone's colour.
function quadrotor() {
  const mesh = new Mesh(), white = [1, 1, 1], dark = [0.22, 0.25, 0.3];
  mesh.prism(circle(0, 0, 0.3, 12), -0.16, 0.16, white, true);
  for (const turn of [Math.PI / 4, -Math.PI / 4]) {
    const c = Math.cos(turn), s = Math.sin(turn);
    mesh.prism([[-0.7, -0.07], [0.7, -0.07], [0.7, 0.07], [-0.7, 0.07]].map(([u, v]) => [c * u - s * v, s * u + c * v]),
      -0.06, 0.06, dark);
    for (const side of [-1, 1]) mesh.prism(circle(0.62 * side * c, 0.62 * side * s, 0.38, 20), 0.1, 0.17, white, true);
  }
  return mesh;
}

// ---- Programs ---------------------------------------------------------------------------------------------

const SOLID = [`#version 300 es
  in vec3 position, normal, color;
  uniform mat4 camera, model;
  out vec3 n, c;
  void main() {
    gl_Position = camera * model * vec4(position, 1.0);
    n = normalize(mat3(model) * normal);
    c = color;
  }`, `#version 300 es
  precision highp float;
  in vec3 n, c;
  uniform vec4 tint;
  out vec4 pixel;
  void main() {
    float light = 0.70 + 0.22 * dot(n, normalize(vec3(0.4, -0.6, 0.7))) + 0.12 * n.z;
    pixel = vec4(c * tint.rgb * light, tint.a);
  }`];

// Lines as quads of constant width in pixels; what lies ahead in time is paler than what has been flown.
const LINE = [`#version 300 es
  in vec3 start, end, color;
  in vec2 corner;
  in float moment, owner;
  uniform mat4 camera;
  uniform vec2 viewport;
  uniform float width, chosen;
  out vec3 c;
  out float when, across, mine;
  void main() {
    vec4 a = camera * vec4(start, 1.0), b = camera * vec4(end, 1.0);
    const float near = 0.01;
    if (a.w < near && b.w > near) a = mix(a, b, (near - a.w) / (b.w - a.w));
    if (b.w < near && a.w > near) b = mix(b, a, (near - b.w) / (a.w - b.w));
    vec2 step = (b.xy / b.w - a.xy / a.w) * viewport;
    vec2 along = length(step) > 1e-6 ? normalize(step) : vec2(1.0, 0.0);
    vec4 p = corner.x < 0.0 ? a : b;
    p.xy += (vec2(-along.y, along.x) * corner.y + 0.4 * along * corner.x) * (width + 1.0) / viewport * p.w;
    p.z -= 2e-4 * p.w;
    gl_Position = p;
    c = color; when = moment; across = corner.y * (width + 1.0) * 0.5;
    mine = chosen < 0.0 || abs(chosen - owner) < 0.5 ? 1.0 : 0.0;
  }`, `#version 300 es
  precision highp float;
  in vec3 c;
  in float when, across, mine;
  uniform float now, width, opacity;
  out vec4 pixel;
  void main() {
    float edge = clamp(0.5 * width + 0.5 - abs(across), 0.0, 1.0);
    // Paler by colour, not by opacity: the ends of neighbouring pieces overlap.
    vec3 ink = mix(vec3(0.95, 0.955, 0.965), c, when <= now ? 1.0 : 0.5);
    pixel = vec4(ink, edge * opacity * (mine > 0.5 ? 1.0 : 0.12));
  }`];

const POINT = [`#version 300 es
  in vec3 position, color;
  in float moment;
  uniform mat4 camera;
  uniform float size, now;
  out vec3 c;
  out float done;
  void main() {
    gl_Position = camera * vec4(position, 1.0);
    gl_Position.z -= 4e-4 * gl_Position.w;
    gl_PointSize = size;
    c = color; done = moment <= now ? 1.0 : 0.0;
  }`, `#version 300 es
  precision highp float;
  in vec3 c;
  in float done;
  uniform float size;
  out vec4 pixel;
  void main() {
    float r = length(gl_PointCoord - 0.5) * size, outer = 0.5 * size;
    float inside = clamp(outer - r, 0.0, 1.0), core = clamp(0.58 * outer - r + 0.5, 0.0, 1.0);
    if (inside <= 0.0) discard;
    pixel = vec4(mix(c, vec3(1.0), core * (1.0 - done)), inside);
  }`];

class Program {
  constructor(gl, [vertex, fragment]) {
    this.gl = gl;
    this.handle = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(this.handle, shader);
    }
    gl.linkProgram(this.handle);
    this.places = new Map();
  }

  // Uploads interleaved numbers; the layout lists [attribute, how many numbers].
  upload(numbers, layout) {
    const gl = this.gl, array = gl.createVertexArray(), stride = layout.reduce((sum, [, count]) => sum + count, 0);
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(numbers), gl.DYNAMIC_DRAW);
    let offset = 0;
    for (const [name, count] of layout) {
      const place = gl.getAttribLocation(this.handle, name);
      if (place >= 0) {
        gl.enableVertexAttribArray(place);
        gl.vertexAttribPointer(place, count, gl.FLOAT, false, 4 * stride, 4 * offset);
      }
      offset += count;
    }
    return { array, count: numbers.length / stride };
  }

  use(uniforms) {
    const gl = this.gl;
    gl.useProgram(this.handle);
    for (const [name, value] of Object.entries(uniforms)) {
      if (!this.places.has(name)) this.places.set(name, gl.getUniformLocation(this.handle, name));
      const place = this.places.get(name);
      if (typeof value === "number") gl.uniform1f(place, value);
      else if (value.length === 16) gl.uniformMatrix4fv(place, false, value);
      else gl[`uniform${value.length}fv`](place, value);
    }
  }

  draw(buffer, mode = this.gl.TRIANGLES) {
    this.gl.bindVertexArray(buffer.array);
    if (buffer.count) this.gl.drawArrays(mode, 0, buffer.count);
  }
}

const SOLID_LAYOUT = [["position", 3], ["normal", 3], ["color", 3]];
const LINE_LAYOUT = [["start", 3], ["end", 3], ["corner", 2], ["color", 3], ["moment", 1], ["owner", 1]];
const POINT_LAYOUT = [["position", 3], ["color", 3], ["moment", 1]];

// Two triangles for the line from p to q, which the drone `owner` flies from `begin` to `finish` seconds.
function addLine(numbers, p, q, color, begin = -1, finish = -1, owner = -1) {
  for (const [x, y] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]])
    numbers.push(...p, ...q, x, y, ...color, x < 0 ? begin : finish, owner);
}
