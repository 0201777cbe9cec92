// Drawing with WebGL 2: instances of lit meshes, lines of constant width, a ground grid. World axes as
// in the flight: x east, y north, z up; lengths in metres, colours [r, g, b, a] from 0 to 1.

// Background, ground and lines on it, and the share of light that falls on things: by day and by night.
const DAY = { background: [0.945, 0.957, 0.969], base: [0.885, 0.902, 0.918], grid: [0.66, 0.71, 0.76], light: 1 };
const NIGHT = { background: [0.02, 0.027, 0.05], base: [0.035, 0.045, 0.07], grid: [0.11, 0.13, 0.18], light: 0.3 };

// -- vectors and matrices ---------------------------------------------------------------------------

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
export const mixed = (a, b, f) => a.map((x, i) => x + f * (b[i] - x));

export function unit(a) {
  const l = length(a);
  return l > 0 ? scaled(a, 1 / l) : [0, 0, 1];
}

/** Clip coordinates from world coordinates, column by column: a camera at `eye` that sees `target` at `centre`. */
function viewMatrix({ eye, target, right, fov, near, far, centre }, aspect) {
  const back = unit(sub(eye, target)), up = cross(back, right);
  const f = 1 / Math.tan(fov / 2), A = (far + near) / (near - far), B = (2 * far * near) / (near - far);
  const row = (v, s) => [v[0] * s, v[1] * s, v[2] * s, -dot(v, eye) * s];
  const x = row(right, f / aspect), y = row(up, f), z = row(back, 1);
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) {
    out[4 * c] = x[c] - centre[0] * z[c];
    out[4 * c + 1] = y[c] - centre[1] * z[c];
    out[4 * c + 2] = A * z[c] + (c === 3 ? B : 0);
    out[4 * c + 3] = -z[c];
  }
  return out;
}

/** Quaternion [w, x, y, z] that turns body to world, from the body's axes x, y, z in the world. */
export function quaternion(x, y, z) {
  const t = [1 + x[0] + y[1] + z[2], 1 + x[0] - y[1] - z[2], 1 - x[0] + y[1] - z[2], 1 - x[0] - y[1] + z[2]];
  const k = t.indexOf(Math.max(...t)), s = 2 * Math.sqrt(t[k]);
  const a = y[2] - z[1], b = z[0] - x[2], c = x[1] - y[0];
  const d = y[0] + x[1], e = z[0] + x[2], f = z[1] + y[2];
  return [
    [s / 4, a / s, b / s, c / s], [a / s, s / 4, d / s, e / s],
    [b / s, d / s, s / 4, f / s], [c / s, e / s, f / s, s / 4],
  ][k];
}

// -- meshes -------------------------------------------------------------------------------------------

// Tone of a vertex: 0 dark, 1 the colour of the thing, 2 white.
export const DARK = 0, OWN = 1, WHITE = 2;

/** Triangles between vertices of position (3), normal (3), tone and opacity. */
export class Mesh {
  constructor() {
    this.data = [];
    this.corners = [];
    this.known = new Map();
  }

  triangle(a, b, c, tone, alpha = [1, 1, 1]) {
    const n = unit(cross(sub(b, a), sub(c, a)));
    [a, b, c].forEach((p, i) => this.corners.push(this.vertex([...p, ...n, tone, alpha[i]])));
  }

  /** Number of a vertex; neighbours on one face share theirs. */
  vertex(values) {
    const key = values.map((x) => x.toFixed(4)).join();
    if (!this.known.has(key)) {
      this.known.set(key, this.data.length / 8);
      this.data.push(...values);
    }
    return this.known.get(key);
  }

  quad(a, b, c, d, tone) {
    this.triangle(a, b, c, tone);
    this.triangle(a, c, d, tone);
  }

  /** Prism (or cone, with no radius at the top) on n sides along z. */
  prism(centre, radius, top, height, n, tone, phase = 0) {
    const at = (k, r, z) => {
      const a = (2 * Math.PI * k) / n + phase;
      return add(centre, [r * Math.cos(a), r * Math.sin(a), z]);
    };
    for (let k = 0; k < n; k++) {
      const a = at(k, radius, 0), b = at(k + 1, radius, 0);
      if (top > 0) {
        const c = at(k + 1, top, height), d = at(k, top, height);
        this.quad(a, b, c, d, tone);
        this.triangle(at(0, 0, height), d, c, tone);
      } else this.triangle(a, b, at(0, 0, height), tone);
      this.triangle(at(0, 0, 0), b, a, tone);
    }
    return this;
  }

  /** Flat ring, or a disc whose opacity runs from inside to outside. */
  ring(centre, inner, outer, n, tone, alpha = [1, 1]) {
    const at = (k, r) => {
      const a = (2 * Math.PI * k) / n;
      return add(centre, [r * Math.cos(a), r * Math.sin(a), 0]);
    };
    const [i, o] = alpha;
    for (let k = 0; k < n; k++) {
      this.triangle(at(k, inner), at(k, outer), at(k + 1, outer), tone, [i, o, o]);
      if (inner > 0) this.triangle(at(k, inner), at(k + 1, outer), at(k + 1, inner), tone, [i, o, i]);
    }
    return this;
  }

  /** Wall of a ring, lit from above and from the side, visible from both sides. */
  guard(centre, radius, height, n, tone) {
    const at = (k, z) => {
      const a = (2 * Math.PI * k) / n;
      return add(centre, [radius * Math.cos(a), radius * Math.sin(a), z]);
    };
    for (let k = 0; k < n; k++) this.quad(at(k, 0), at(k + 1, 0), at(k + 1, height), at(k, height), tone);
    return this.ring(add(centre, [0, 0, height]), 0.86 * radius, radius, n, tone);
  }

  /** Box along the axes, turned by an angle about z. */
  box(low, high, tone, turn = 0) {
    const c = Math.cos(turn), s = Math.sin(turn);
    const at = (i, j, k) => {
      const x = i ? high[0] : low[0], y = j ? high[1] : low[1];
      return [c * x - s * y, s * x + c * y, k ? high[2] : low[2]];
    };
    this.quad(at(0, 0, 1), at(1, 0, 1), at(1, 1, 1), at(0, 1, 1), tone);
    this.quad(at(0, 0, 0), at(0, 1, 0), at(1, 1, 0), at(1, 0, 0), tone);
    this.quad(at(1, 0, 0), at(1, 1, 0), at(1, 1, 1), at(1, 0, 1), tone);
    this.quad(at(0, 0, 0), at(0, 0, 1), at(0, 1, 1), at(0, 1, 0), tone);
    this.quad(at(0, 1, 0), at(0, 1, 1), at(1, 1, 1), at(1, 1, 0), tone);
    this.quad(at(0, 0, 0), at(1, 0, 0), at(1, 0, 1), at(0, 0, 1), tone);
    return this;
  }
}

/** Angle from the nose and place of each rotor, in units of the radius: front left, rear left, rear right, front right. */
export const ROTORS = [0, 1, 2, 3].map((k) => {
  const angle = Math.PI / 4 + (k * Math.PI) / 2;
  return [angle, 0.58 * Math.cos(angle), 0.58 * Math.sin(angle)];
});

/** A quadrotor inside a sphere of radius 1, nose along x. */
export function vehicleMesh() {
  const mesh = new Mesh();
  mesh.prism([0, 0, -0.14], 0.26, 0.17, 0.34, 8, OWN, Math.PI / 8);
  mesh.box([0.14, -0.08, -0.05], [0.37, 0.08, 0.1], WHITE);
  for (const [angle, x, y] of ROTORS) {
    mesh.box([0.1, -0.05, -0.04], [0.6, 0.05, 0.05], DARK, angle);
    mesh.prism([x, y, -0.1], 0.1, 0.07, 0.26, 6, DARK);
    mesh.guard([x, y, 0.04], 0.41, 0.16, 16, OWN);
  }
  return mesh;
}

/** A simpler one for distant vehicles, a tenth of the work. */
export function smallVehicleMesh() {
  const mesh = new Mesh();
  mesh.prism([0, 0, -0.14], 0.3, 0, 0.42, 4, OWN, Math.PI / 4);
  for (const [, x, y] of ROTORS) {
    mesh.triangle([0.13 * y, -0.13 * x, 0], [x, y, 0.04], [-0.13 * y, 0.13 * x, 0], DARK);
    mesh.ring([x, y, 0.12], 0, 0.41, 6, OWN, [0.8, 1]);
  }
  return mesh;
}

/** The simplest one, for crowds that are drawn without a graphics card: a body and four flat squares. */
export function farVehicleMesh() {
  const mesh = new Mesh();
  mesh.prism([0, 0, -0.1], 0.3, 0, 0.4, 3, OWN);
  for (const [, x, y] of ROTORS) mesh.quad([x + 0.4, y, 0.12], [x, y + 0.4, 0.12], [x - 0.4, y, 0.12], [x, y - 0.4, 0.12], OWN);
  return mesh;
}

/** An arrow ahead of vehicles whose own yaw is known. */
export function noseMesh() {
  const mesh = new Mesh().box([0.3, -0.05, -0.03], [1, 0.05, 0.03], DARK);
  mesh.triangle([0.95, 0.24, 0], [0.95, -0.24, 0], [1.45, 0, 0], DARK);
  return mesh;
}

/** A ball of radius 1. */
export function ballMesh() {
  const mesh = new Mesh(), N = 12;
  const at = (i, j) => {
    const a = (Math.PI * i) / N, b = (Math.PI * j) / N;
    return [Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a)];
  };
  for (let i = 0; i < N; i++) {
    for (let j = 0; j < 2 * N; j++) {
      if (i > 0) mesh.triangle(at(i, j), at(i + 1, j), at(i, j + 1), OWN);
      if (i < N - 1) mesh.triangle(at(i + 1, j), at(i + 1, j + 1), at(i, j + 1), OWN);
    }
  }
  return mesh;
}

/** One rotor at the centre. */
export function discMesh() {
  return new Mesh().ring([0, 0, 0], 0, 0.39, 14, OWN, [0.25, 1]);
}

export function rotorMesh() {
  const mesh = new Mesh();
  for (const [, x, y] of ROTORS) mesh.ring([x, y, 0.14], 0, 0.39, 14, OWN, [0.1, 0.45]);
  return mesh;
}

// -- instances ---------------------------------------------------------------------

/** Reach of a light's glow beyond its vehicle, in radii. */
const GLOW = 3;
/** Number of items in a row of their texture; each takes 12 words (three texels). */
const PER_ROW = 256;
export const NO_TURN = [1, 0, 0, 0];

class Items {
  constructor() {
    this.hold(new Float32Array(12 * PER_ROW));
    this.count = 0;
  }

  hold(data) {
    this.data = data;
    this.words = new Uint32Array(data.buffer);
  }

  clear() {
    this.count = 0;
  }

  /** Index at which the next item begins. */
  next() {
    const at = 12 * this.count++;
    if (at + 12 > this.data.length) this.hold(grown(this.data));
    return at;
  }
}

/** Instances of a mesh: position, colour, scale and quaternion. */
export class Places extends Items {
  add(p, scale, q, colour, alpha) {
    const at = this.next(), d = this.data, one = typeof scale === "number";
    d[at] = p[0]; d[at + 1] = p[1]; d[at + 2] = p[2];
    this.words[at + 3] = packed(colour, alpha);
    d[at + 4] = one ? scale : scale[0]; d[at + 5] = one ? scale : scale[1]; d[at + 6] = one ? scale : scale[2];
    d[at + 7] = q[0]; d[at + 8] = q[1]; d[at + 9] = q[2]; d[at + 10] = q[3];
  }
}

/** Segments: one end, width [px]; the other end; the colours of both. */
export class Lines extends Items {
  add(a, b, width, colour, alpha, alphaB = alpha) {
    const at = this.next(), d = this.data;
    d[at] = a[0]; d[at + 1] = a[1]; d[at + 2] = a[2]; d[at + 3] = width;
    d[at + 4] = b[0]; d[at + 5] = b[1]; d[at + 6] = b[2];
    this.words[at + 8] = packed(colour, alpha);
    this.words[at + 9] = packed(colour, alphaB);
  }
}

function packed(colour, alpha) {
  return ((alpha * 255) << 24) | ((colour[2] * 255) << 16) | ((colour[1] * 255) << 8) | (colour[0] * 255);
}

export function grown(data) {
  const larger = new Float32Array(2 * data.length);
  larger.set(data);
  return larger;
}

// -- the renderer -------------------------------------------------------------------------------------

const FOG = `
vec3 fogged(vec3 colour, vec3 place) {
  float far = 1.0 - exp(-max(distance(place, u_eye) / u_fog - 0.6, 0.0));
  return mix(colour, u_background, 0.75 * far);
}`;

// Items are read from a texture: thousands of small instances are slow without a graphics card.
const ITEM = `
precision highp usampler2D;
uniform usampler2D u_items;
uvec4 word(int item, int part) {
  return texelFetch(u_items, ivec2(3 * (item % ${PER_ROW}) + part, item / ${PER_ROW}), 0);
}
vec4 unpacked(uint colour) { return vec4((uvec4(colour) >> uvec4(0u, 8u, 16u, 24u)) & 255u) / 255.0; }`;

const MESH_VERTEX = `#version 300 es
layout(location=0) in vec3 a_position;
layout(location=1) in vec3 a_normal;
layout(location=2) in vec3 a_look; // tone, opacity, number of the copy
uniform int u_first;
uniform mat4 u_view;
uniform vec3 u_eye, u_background;
uniform float u_fog, u_light;
out vec4 v_colour;
${ITEM}
${FOG}
vec3 turned(vec3 v, vec4 q) { return v + 2.0 * cross(q.yzw, cross(q.yzw, v) + q.x * v); }
void main() {
  int item = u_first + int(a_look.z);
  uvec4 first = word(item, 0);
  vec4 second = uintBitsToFloat(word(item, 1)), third = uintBitsToFloat(word(item, 2));
  vec4 turn = vec4(second.w, third.xyz), given = unpacked(first.w);
  vec3 place = uintBitsToFloat(first.xyz) + turned(a_position * second.xyz, turn), n = turned(a_normal, turn);
  float light = 0.71 + 0.06 * n.z + 0.30 * max(dot(n, vec3(0.36, -0.30, 0.88)), 0.0);
  vec3 own = a_look.x < 0.5 ? vec3(0.17, 0.19, 0.22) : a_look.x < 1.5 ? given.rgb : vec3(0.98);
  v_colour = vec4(fogged(own * light * u_light, place), given.a * a_look.y);
  gl_Position = u_view * vec4(place, 1.0);
}`;

const PLAIN_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 v_colour;
out vec4 colour;
void main() { colour = v_colour; }`;

// A segment becomes a quad that is `width` pixels wide; its borders fade over one pixel.
const LINE_VERTEX = `#version 300 es
uniform mat4 u_view;
uniform vec2 u_half;
uniform float u_near, u_fog, u_pixel;
uniform vec3 u_eye, u_background;
out vec4 v_colour;
out vec2 v_across;
${ITEM}
${FOG}
void main() {
  int segment = gl_VertexID >> 2, corner = gl_VertexID & 3;
  vec4 first = uintBitsToFloat(word(segment, 0));
  vec3 i_a = first.xyz, i_b = uintBitsToFloat(word(segment, 1).xyz);
  uvec2 colours = word(segment, 2).xy;
  vec4 a = u_view * vec4(i_a, 1.0), b = u_view * vec4(i_b, 1.0);
  if (a.w < u_near && b.w < u_near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (a.w < u_near) a = mix(a, b, (u_near - a.w) / (b.w - a.w));
  if (b.w < u_near) b = mix(b, a, (u_near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * u_half;
  along = dot(along, along) > 0.0 ? normalize(along) : vec2(1.0, 0.0);
  bool end = (corner & 1) == 1;
  float side = corner < 2 ? -1.0 : 1.0;
  float reach = 0.5 * first.w * u_pixel + 0.75;
  vec4 p = end ? b : a;
  p.xy += vec2(-along.y, along.x) * side * reach / u_half * p.w;
  gl_Position = p;
  v_across = vec2(side * reach, reach);
  vec4 own = unpacked(end ? colours.y : colours.x);
  v_colour = vec4(fogged(own.rgb, end ? i_b : i_a), own.a);
}`;

const LINE_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 v_colour;
in vec2 v_across;
out vec4 colour;
void main() {
  colour = vec4(v_colour.rgb, v_colour.a * clamp(v_across.y - abs(v_across.x), 0.0, 1.0));
}`;

// Vehicles of a swarm, one dot each.
const DOT_VERTEX = `#version 300 es
layout(location=0) in vec3 a_position;
layout(location=1) in float a_radius;
layout(location=2) in vec4 a_colour;
uniform mat4 u_view;
uniform vec3 u_eye, u_background;
uniform float u_fog, u_pixels, u_least, u_ground, u_shade, u_glow; // a shade lies on the ground, a glow before its vehicle
out vec4 v_colour;
${FOG}
void main() {
  vec3 place = u_shade > 0.0 ? vec3(a_position.xy, u_ground) : a_position;
  place += u_glow * a_radius * normalize(u_eye - place);
  gl_Position = u_view * vec4(place, 1.0);
  gl_PointSize = 2.0 * max((1.0 + u_glow) * a_radius * u_pixels / max(gl_Position.w, 1e-6), u_least);
  v_colour = u_shade > 0.0 ? vec4(0.13, 0.15, 0.18, u_shade) : vec4(u_glow > 0.0 ? a_colour.rgb : fogged(a_colour.rgb, place), 1.0);
}`;

const DOT_FRAGMENT = `#version 300 es
precision highp float;
uniform float u_glow;
in vec4 v_colour;
out vec4 colour;
void main() {
  vec2 d = gl_PointCoord - 0.5;
  if (dot(d, d) > 0.25) discard;
  if (u_glow > 0.0) { // a bright point in a faint halo, which add up
    float far = 4.0 * dot(d, d);
    colour = vec4(v_colour.rgb * (1.4 * exp(-30.0 * far) + 0.5 * exp(-9.0 * far) + 0.12 * (1.0 - far)), 1.0);
    return;
  }
  colour = vec4(v_colour.rgb * (1.05 - 0.4 * gl_PointCoord.y), v_colour.a);
}`;

const GROUND_VERTEX = `#version 300 es
uniform mat4 u_view;
uniform vec3 u_centre;
uniform float u_reach;
out vec2 v_place;
void main() {
  v_place = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  gl_Position = u_view * vec4(u_centre + vec3(v_place * u_reach, 0.0), 1.0);
}`;

// Lines thinner than a pixel fade out before they can flicker.
const GROUND_FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 u_base, u_grid;
uniform vec2 u_offset;
uniform float u_reach, u_step, u_solid;
in vec2 v_place;
out vec4 colour;
float grid(vec2 p, vec2 d, float width) {
  vec2 g = abs(fract(p - 0.5) - 0.5) / d;
  return max(1.0 - min(g.x, g.y) / width, 0.0) * (1.0 - smoothstep(0.15, 0.5, max(d.x, d.y)));
}
void main() {
  float fade = 1.0 - smoothstep(0.15, 1.0, length(v_place));
  vec2 p = v_place * (u_reach / u_step) + u_offset, d = max(fwidth(p), 1e-6);
  float line = max(0.5 * grid(p, d, 1.1), grid(0.1 * p, 0.1 * d, 1.5));
  colour = vec4(mix(u_base, u_grid, line), fade * max(u_solid, line));
}`;

/** Whether WebGL runs in software, without a graphics card. */
function inSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  // Chromium names the renderer in an extension alone.
  const told = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = `${gl?.getParameter(gl.RENDERER)} ${told ? gl.getParameter(told.UNMASKED_RENDERER_WEBGL) : ""}`;
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

export class Renderer {
  constructor(canvas) {
    // Antialiasing is free on a graphics card, and four times the work in software.
    this.software = inSoftware();
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: !this.software, powerPreference: "high-performance" });
    if (!gl) throw new Error("WebGL 2 is not available");
    this.canvas = canvas;
    this.gl = gl;
    this.effort = this.software ? 0.7 : 1; // share of the resolution, lowered where drawing is slow
    this.scale = 1;
    this.night = false;
    this.mesh = this.program(MESH_VERTEX, PLAIN_FRAGMENT);
    this.line = this.program(LINE_VERTEX, LINE_FRAGMENT);
    this.grid = this.program(GROUND_VERTEX, GROUND_FRAGMENT);
    this.dot = null; // made for swarms alone
    this.items = gl.createTexture();
    this.rows = 0;
    this.corners = gl.createVertexArray(); // of segments, two triangles each
    this.empty = gl.createVertexArray();
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  get look() {
    return this.night ? NIGHT : DAY;
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const logs = gl.getAttachedShaders(program).map((s) => gl.getShaderInfoLog(s));
      throw new Error(`shader: ${[gl.getProgramInfoLog(program), ...logs].join(" ")}`);
    }
    const uniforms = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  /** A mesh on the graphics card, with the number of copies drawn at once. */
  upload(mesh) {
    const gl = this.gl, array = gl.createVertexArray(), vertices = mesh.data.length / 8;
    const copies = Math.max(1, Math.min(Math.floor(16384 / vertices), PER_ROW));
    const data = new Float32Array(9 * vertices * copies), corners = new Uint32Array(mesh.corners.length * copies);
    for (let c = 0; c < copies; c++) {
      for (let v = 0; v < vertices; v++) {
        data.set(mesh.data.slice(8 * v, 8 * v + 8), 9 * (c * vertices + v));
        data[9 * (c * vertices + v) + 8] = c;
      }
      corners.set(mesh.corners.map((corner) => corner + c * vertices), c * mesh.corners.length);
    }
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    for (let k = 0; k < 3; k++) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 36, 12 * k);
    }
    gl.bindVertexArray(null);
    return { array, copies, corners: mesh.corners.length };
  }

  /** Begin a picture seen by a camera {eye, target, right, centre (clip coordinates), fov, near, far, fog}. */
  begin(camera) {
    const { gl, canvas } = this, ratio = this.scale * Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.camera = camera;
    this.view = viewMatrix(camera, width / height);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.look.background, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    for (const { program, uniforms } of [this.mesh, this.line, this.grid, this.dot].filter(Boolean)) {
      gl.useProgram(program);
      gl.uniformMatrix4fv(uniforms.u_view, false, this.view);
      if (uniforms.u_background) gl.uniform3fv(uniforms.u_background, this.look.background);
      if (uniforms.u_light) gl.uniform1f(uniforms.u_light, this.look.light);
      if (uniforms.u_eye) gl.uniform3fv(uniforms.u_eye, camera.eye);
      if (uniforms.u_fog) gl.uniform1f(uniforms.u_fog, camera.fog);
    }
    gl.useProgram(this.line.program);
    gl.uniform2f(this.line.uniforms.u_half, width / 2, height / 2);
    gl.uniform1f(this.line.uniforms.u_near, camera.near);
    gl.uniform1f(this.line.uniforms.u_pixel, ratio);
  }

  /** Depth mode of later drawing: true tests and writes depth, `false` only tests it, null does neither. */
  depth(writes) {
    const gl = this.gl;
    if (writes === null) gl.disable(gl.DEPTH_TEST);
    else gl.enable(gl.DEPTH_TEST);
    gl.depthMask(writes === true);
  }

  ground(centre, reach, step, solid) {
    const { gl } = this, { program, uniforms } = this.grid;
    gl.useProgram(program);
    gl.bindVertexArray(this.empty);
    gl.uniform3fv(uniforms.u_centre, centre);
    gl.uniform1f(uniforms.u_reach, reach);
    gl.uniform1f(uniforms.u_step, step);
    gl.uniform1f(uniforms.u_solid, solid ? 1 : 0);
    gl.uniform3fv(uniforms.u_base, solid ? this.look.base : this.look.background);
    gl.uniform3fv(uniforms.u_grid, this.look.grid);
    gl.uniform2f(uniforms.u_offset, (centre[0] / step) % 10, (centre[1] / step) % 10);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  /** Fill the texture with items. */
  hold(items) {
    const { gl } = this, rows = Math.ceil(items.count / PER_ROW), width = 3 * PER_ROW;
    gl.bindTexture(gl.TEXTURE_2D, this.items);
    if (rows > this.rows) {
      this.rows = items.data.length / (12 * PER_ROW);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, width, this.rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, null);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      const corner = (k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6];
      gl.bindVertexArray(this.corners);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from({ length: 6 * PER_ROW * this.rows }, (_, k) => corner(k)), gl.STATIC_DRAW);
    }
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, items.words);
  }

  meshes(mesh, places) {
    if (!places.count) return;
    const { gl } = this;
    this.hold(places);
    gl.useProgram(this.mesh.program);
    gl.bindVertexArray(mesh.array);
    for (let first = 0; first < places.count; first += mesh.copies) {
      gl.uniform1i(this.mesh.uniforms.u_first, first);
      gl.drawElements(gl.TRIANGLES, mesh.corners * Math.min(mesh.copies, places.count - first), gl.UNSIGNED_INT, 0);
    }
  }

  /** Vehicles that are drawn as dots: radii (n,) and colours (n x 4 bytes), which change only where they glow. */
  swarm(radius, colours) {
    const { gl } = this, array = gl.createVertexArray(), places = gl.createBuffer();
    this.dot ??= this.program(DOT_VERTEX, DOT_FRAGMENT);
    gl.bindVertexArray(array);
    const column = (index, buffer, data, width, kind, scaled) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      if (data) gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, width, kind, scaled, 0, 0);
    };
    column(0, places, null, 3, gl.FLOAT, false);
    const lights = gl.createBuffer();
    column(1, gl.createBuffer(), radius, 1, gl.FLOAT, false);
    column(2, lights, colours, 4, gl.UNSIGNED_BYTE, true);
    gl.bindVertexArray(null);
    return { array, places, lights, count: radius.length };
  }

  /**
   * Draw a swarm at its places (n x 3), or its shades on the ground at a height. `pixels` cover a metre at 1 m, and no dot
   * has a smaller radius than `least` [px]. With `lights` (n x 4 bytes), dots glow in these colours.
   */
  dots(swarm, places, pixels, least, ground = null, lights = null) {
    const { gl } = this, { program, uniforms } = this.dot, ratio = this.canvas.width / Math.max(this.canvas.clientWidth, 1);
    gl.useProgram(program);
    gl.uniform1f(uniforms.u_pixels, pixels * ratio);
    gl.uniform1f(uniforms.u_least, least * ratio);
    gl.uniform1f(uniforms.u_ground, ground ?? 0);
    gl.uniform1f(uniforms.u_shade, ground === null ? 0 : 0.14);
    gl.uniform1f(uniforms.u_glow, lights ? GLOW : 0);
    gl.bindVertexArray(swarm.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, swarm.places);
    gl.bufferData(gl.ARRAY_BUFFER, places, gl.DYNAMIC_DRAW);
    if (lights) {
      gl.bindBuffer(gl.ARRAY_BUFFER, swarm.lights);
      gl.bufferData(gl.ARRAY_BUFFER, lights, gl.DYNAMIC_DRAW);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE);
    }
    gl.drawArrays(gl.POINTS, 0, swarm.count);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  lines(lines) {
    if (!lines.count) return;
    const { gl } = this;
    this.hold(lines);
    gl.useProgram(this.line.program);
    gl.bindVertexArray(this.corners);
    gl.drawElements(gl.TRIANGLES, 6 * lines.count, gl.UNSIGNED_INT, 0);
  }

  /** Direction in the world in which a point of the page [px] is seen. */
  ray(x, y) {
    const { eye, target, right, fov, centre } = this.camera, back = unit(sub(eye, target)), up = cross(back, right);
    const { clientWidth: wide, clientHeight: high } = this.canvas, t = Math.tan(fov / 2);
    const a = ((2 * x) / wide - 1 - centre[0]) * t * (wide / high), b = (1 - (2 * y) / high - centre[1]) * t;
    return unit(add(add(scaled(right, a), scaled(up, b)), scaled(back, -1)));
  }

  /** Position of a point on the page [px] and its distance ahead [m]; null behind the camera. */
  project(p) {
    const m = this.view, w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
    if (w < this.camera.near) return null;
    const x = (m[0] * p[0] + m[4] * p[1] + m[8] * p[2] + m[12]) / w;
    const y = (m[1] * p[0] + m[5] * p[1] + m[9] * p[2] + m[13]) / w;
    return [((x + 1) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight, w];
  }
}
