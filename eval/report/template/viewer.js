// A small WebGL2 viewer: points, lines, orbit camera. World is z up.
// A frame draws as many points as fit into it (they come in random order: the first ones are a thinner picture of the
// same map); once nothing moves, the following frames add the rest without clearing. So no frame is long, and a slow
// machine shows the whole map a moment later.
const FRAME_MS = 33, FIRST_POINTS = 20000, FEWEST_POINTS = 4000, REST_MS = 120;
const POINT_VS = `#version 300 es
layout(location=0) in vec3 a_position; layout(location=1) in vec3 a_colour; layout(location=2) in float a_sigma; layout(location=3) in float a_obs;
uniform mat4 u_view, u_projection; uniform vec3 u_lo, u_extent, u_flat; uniform int u_mode; uniform vec2 u_range; uniform float u_size, u_sigmaMax, u_ortho;
uniform sampler2D u_ramp; out vec3 v_colour;
void main() {
  vec3 p = u_lo + a_position * u_extent;
  vec4 eye = u_view * vec4(p, 1.0);
  gl_Position = a_sigma > u_sigmaMax ? vec4(2.0, 2.0, 2.0, 1.0) : u_projection * eye;
  gl_PointSize = clamp(u_size / (u_ortho > 0.0 ? u_ortho : -eye.z), 1.25, 9.0);
  float t = u_mode == 1 ? (p.z - u_range.x) / (u_range.y - u_range.x) : u_mode == 2 ? a_obs : 1.0 - a_sigma;
  v_colour = u_mode == 0 ? a_colour : u_mode == 4 ? u_flat : texture(u_ramp, vec2(clamp(t, 0.01, 0.99), 0.5)).rgb;
}`;
const POINT_FS = `#version 300 es
precision mediump float; in vec3 v_colour; uniform float u_lift; out vec4 o;
void main() { vec2 d = gl_PointCoord - 0.5; if (dot(d, d) > 0.25) discard; o = vec4(mix(v_colour, vec3(1.0), u_lift), 1.0); }`;
const LINE_VS = `#version 300 es
layout(location=0) in vec3 a_position; layout(location=1) in vec3 a_colour; uniform mat4 u_view, u_projection; out vec3 v_colour;
void main() { v_colour = a_colour; gl_Position = u_projection * (u_view * vec4(a_position, 1.0)); }`;
const LINE_FS = `#version 300 es
precision mediump float; in vec3 v_colour; out vec4 o; void main() { o = vec4(v_colour, 1.0); }`;

const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross3 = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const add3 = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const unit3 = a => { const n = Math.hypot(...a) || 1; return a.map(x => x / n); };

// Whether there is no graphics card: smooth lines would then cost half of every frame.
function drawnByProcessor() {
  const gl = document.createElement("canvas").getContext("webgl2"), info = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl ? gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : "";
  const lose = gl && gl.getExtension("WEBGL_lose_context"); if (lose) lose.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

class Viewer {
  constructor(canvas, onChange) {
    this.canvas = canvas; this.onChange = onChange;
    this.show = { edges: true, anchors: false, trajectory: true, cameras: true, truth: true, grid: true };
    this.mode = 0; this.size = 10; this.sigmaMax = 1; this.lines = {}; this.view = "free"; this.pending = false;
    this.moving = false; this.dirty = true; this.drawn = 0; this.budget = FIRST_POINTS; this.last = 0;
    const gl = this.gl = canvas.getContext("webgl2", { preserveDrawingBuffer: true, antialias: !drawnByProcessor() });
    if (!gl) return;
    this.points = this.program(POINT_VS, POINT_FS); this.line = this.program(LINE_VS, LINE_FS);
    this.rampTexture();
    this.clouds = { anchors: this.upload(ANCHORS), edges: this.upload(EDGES) };
    gl.enable(gl.DEPTH_TEST);
    this.home(); this.listen();
    new ResizeObserver(() => this.request()).observe(canvas);
  }

  program(vs, fs) {
    const gl = this.gl, p = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vs], [gl.FRAGMENT_SHADER, fs]]) {
      const s = gl.createShader(type); gl.shaderSource(s, source); gl.compileShader(s); gl.attachShader(p, s);
      if (!gl.getShaderParameter(s, gl.COMPILE_STATUS)) console.error(gl.getShaderInfoLog(s));
    }
    gl.linkProgram(p);
    const u = {};
    for (let i = 0; i < gl.getProgramParameter(p, gl.ACTIVE_UNIFORMS); i++) { const { name } = gl.getActiveUniform(p, i); u[name] = gl.getUniformLocation(p, name); }
    return { p, u };
  }

  rampTexture() {
    const gl = this.gl, data = new Uint8Array(256 * 4);
    for (let i = 0; i < 256; i++) data.set([...ramp(i / 255), 255], 4 * i);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, data);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  }

  // One buffer of 12 bytes a point (x y z, sigma, observations, colour, nothing), one draw call.
  upload(c) {
    const gl = this.gl, vao = gl.createVertexArray(), buffer = new ArrayBuffer(12 * c.n), u16 = new Uint16Array(buffer), u8 = new Uint8Array(buffer);
    for (let i = 0; i < c.n; i++) {
      for (let k = 0; k < 3; k++) { u16[6 * i + k] = c.position[3 * i + k]; u8[12 * i + 8 + k] = c.colour[3 * i + k]; }
      u8[12 * i + 6] = c.sigmaCode[i]; u8[12 * i + 7] = c.obsCode[i];
    }
    gl.bindVertexArray(vao); gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer()); gl.bufferData(gl.ARRAY_BUFFER, buffer, gl.STATIC_DRAW);
    [[3, gl.UNSIGNED_SHORT, 0], [3, gl.UNSIGNED_BYTE, 8], [1, gl.UNSIGNED_BYTE, 6], [1, gl.UNSIGNED_BYTE, 7]].forEach(([n, type, at], i) => {
      gl.enableVertexAttribArray(i); gl.vertexAttribPointer(i, n, type, true, 12, at);
    });
    return { vao, n: c.n, lo: c.lo, extent: c.hi.map((h, k) => h - c.lo[k]) };
  }

  // Lines: {vertices: [x,y,z]*, colours: [r,g,b]*, strip: bool}
  setLines(name, { vertices, colours, strip }) {
    const gl = this.gl; if (!gl) return;
    const old = this.lines[name];
    const vao = old ? old.vao : gl.createVertexArray(), buffers = old ? old.buffers : [gl.createBuffer(), gl.createBuffer()];
    gl.bindVertexArray(vao);
    [vertices, colours].forEach((data, i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[i]); gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(data), gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(i); gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 0, 0);
    });
    this.lines[name] = { vao, buffers, n: vertices.length / 3, strip, count: vertices.length / 3 };
  }

  home() { const h = DATA.home; this.target = [...h.target]; this.radius = h.radius; this.yaw = h.yaw; this.pitch = 0.62; this.distance = 1.7 * h.radius; this.view = "free"; this.request(); }

  setView(name) {
    this.home(); this.view = name;
    if (name === "top") { this.pitch = Math.PI / 2; this.yaw = -Math.PI / 2; }
    if (name === "side") { this.pitch = 0; this.yaw = -Math.PI / 2; }
    if (name === "front") { this.pitch = 0; this.yaw = Math.PI; }
    this.onChange(this); this.request();
  }

  basis() {
    const [cp, sp, cy, sy] = [Math.cos(this.pitch), Math.sin(this.pitch), Math.cos(this.yaw), Math.sin(this.yaw)];
    const back = [cp * cy, cp * sy, sp], right = [-sy, cy, 0];
    return { back, right, up: cross3(back, right) };
  }

  listen() {
    const c = this.canvas, fingers = new Map(); let gap = 0, middle = null;
    const centre = () => { const p = [...fingers.values()]; return [p.reduce((s, q) => s + q[0], 0) / p.length, p.reduce((s, q) => s + q[1], 0) / p.length]; };
    c.addEventListener("contextmenu", e => e.preventDefault());
    c.addEventListener("pointerdown", e => { c.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); gap = 0; middle = centre(); });
    const lift = e => { fingers.delete(e.pointerId); gap = 0; middle = fingers.size ? centre() : null; };
    c.addEventListener("pointerup", lift); c.addEventListener("pointercancel", lift);
    c.addEventListener("pointermove", e => {
      const last = fingers.get(e.pointerId); if (!last) return;
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      if (fingers.size === 1) {
        const dx = e.clientX - last[0], dy = e.clientY - last[1];
        if (e.buttons & 2 || e.shiftKey) this.pan(dx, dy); else this.turn(dx, dy);
      } else if (fingers.size === 2) {
        const [a, b] = [...fingers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]), at = centre();
        if (gap) this.zoom(gap / now);
        if (middle) this.pan(at[0] - middle[0], at[1] - middle[1]);
        gap = now; middle = at;
      }
    });
    c.addEventListener("wheel", e => { e.preventDefault(); this.zoom(Math.exp(Math.sign(e.deltaY) * Math.min(Math.abs(e.deltaY), 100) * 0.0015)); }, { passive: false });
    c.addEventListener("dblclick", () => this.setView(this.view));
    c.addEventListener("keydown", e => {
      const step = { ArrowLeft: [-30, 0], ArrowRight: [30, 0], ArrowUp: [0, -30], ArrowDown: [0, 30] }[e.key];
      if (step) { e.preventDefault(); e.shiftKey ? this.pan(...step) : this.turn(...step); }
      if (e.key === "+" || e.key === "=") this.zoom(0.9);
      if (e.key === "-") this.zoom(1.1);
    });
  }

  turn(dx, dy) {
    this.yaw -= dx * 0.006; this.pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, this.pitch + dy * 0.006));
    if (this.view !== "free") { this.view = "free"; this.onChange(this); }
    this.request(true);
  }
  zoom(f) { this.distance = Math.min(Math.max(this.distance * f, 0.02 * this.radius), 20 * this.radius); this.request(true); }
  pan(dx, dy) {
    const { right, up } = this.basis(), s = this.distance * 2 * Math.tan(0.42) / this.canvas.clientHeight;
    this.target = add3(add3(this.target, right, -dx * s), up, dy * s); this.request(true);
  }

  // Something has changed: the next frame starts a new picture. `moving`: more changes are on their way.
  request(moving = false) {
    if (!this.gl) return;
    this.dirty = true;
    if (moving) {
      this.moving = true; clearTimeout(this.rest);
      this.rest = setTimeout(() => { this.moving = false; this.next(); }, REST_MS);
    }
    this.next();
  }

  next() {
    if (this.pending) return;
    this.pending = true; requestAnimationFrame(now => this.frame(now));
  }

  // One frame: a new picture with its first points, or further points into the present one.
  frame(now) {
    this.pending = false;
    this.adapt(now);
    const total = this.total();
    if (this.dirty) { this.dirty = false; this.begin(); this.drawn = 0; }
    else if (this.moving || this.drawn >= total) return;
    this.drawPoints(this.drawn, this.drawn + this.budget); this.drawn += this.budget;
    if (this.drawn < total && !this.moving) this.next();
  }

  // Points a frame, from the time since the last one; a gap of a second was a pause, not a frame.
  adapt(now) {
    const took = now - this.last; this.last = now;
    if (took <= 0 || took > 1000) return;
    const factor = took > 1.3 * FRAME_MS ? Math.max(0.25, FRAME_MS / took) : took < 0.75 * FRAME_MS ? 1.3 : 1;
    this.budget = Math.round(Math.min(Math.max(this.budget * factor, FEWEST_POINTS), Math.max(this.total(), FIRST_POINTS)));
  }

  total() { return Object.entries(this.clouds).reduce((s, [name, k]) => s + (this.show[name] ? k.n : 0), 0); }

  matrices() {
    const { back, right, up } = this.basis(), eye = add3(this.target, back, this.distance);
    const view = [right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0, -dot3(right, eye), -dot3(up, eye), -dot3(back, eye), 1];
    const w = this.canvas.width / this.canvas.height, f = Math.min(1, w) / Math.tan(0.42), reach = this.distance + 30 * this.radius, near = Math.max(this.distance - 6 * this.radius, 0.004 * this.radius);
    let projection;
    if (this.view === "free") projection = [f / w, 0, 0, 0, 0, f, 0, 0, 0, 0, (reach + near) / (near - reach), -1, 0, 0, 2 * reach * near / (near - reach), 0];
    else { const h = this.distance / f; projection = [1 / (h * w), 0, 0, 0, 0, 1 / h, 0, 0, 0, 0, -1 / reach, 0, 0, 0, 0, 1]; }
    return { view, projection, focal: f * this.canvas.height / 2 };
  }

  // The whole picture at once.
  draw(points = Infinity) { this.begin(); this.drawPoints(0, points); }

  // Empty canvas with the lines on it.
  begin() {
    const gl = this.gl, c = this.canvas, ratio = Math.min(devicePixelRatio || 1, 2);
    const width = Math.round(c.clientWidth * ratio), height = Math.round(c.clientHeight * ratio);
    if (width && height && (c.width !== width || c.height !== height)) { c.width = width; c.height = height; }
    gl.viewport(0, 0, c.width, c.height);
    gl.clearColor(...rgb("--stage"), 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { view, projection } = this.matrices();
    gl.useProgram(this.line.p);
    gl.uniformMatrix4fv(this.line.u.u_view, false, view); gl.uniformMatrix4fv(this.line.u.u_projection, false, projection);
    for (const [name, l] of Object.entries(this.lines)) {
      if (!this.show[name === "current" ? "cameras" : name] || !l.count) continue;
      gl.bindVertexArray(l.vao); gl.drawArrays(l.strip ? gl.LINE_STRIP : gl.LINES, 0, l.count);
    }
  }

  // Points from..to of what is shown, anchors (few, and easily hidden) first.
  drawPoints(from, to) {
    const gl = this.gl, { view, projection, focal } = this.matrices(), u = this.points.u;
    gl.useProgram(this.points.p);
    gl.uniformMatrix4fv(u.u_view, false, view); gl.uniformMatrix4fv(u.u_projection, false, projection);
    gl.uniform1f(u.u_ortho, this.view === "free" ? 0 : this.distance);
    gl.uniform2f(u.u_range, ...DATA.height); gl.uniform3f(u.u_flat, ...rgb("--predicted"));
    gl.uniform1f(u.u_sigmaMax, this.sigmaMax);
    let before = 0;
    for (const [name, k] of Object.entries(this.clouds)) {
      if (!this.show[name] || !k.n) continue;
      const first = Math.max(0, from - before), last = Math.min(k.n, to - before);
      before += k.n;
      if (last <= first) continue;
      gl.uniform3f(u.u_lo, ...k.lo); gl.uniform3f(u.u_extent, ...k.extent);
      gl.uniform1i(u.u_mode, name === "anchors" ? 4 : this.mode);
      // Dark camera colours would vanish on a dark ground: lifted a little there.
      gl.uniform1f(u.u_lift, this.mode === 0 && name === "edges" && matchMedia("(prefers-color-scheme: dark)").matches ? 0.16 : 0);
      gl.uniform1f(u.u_size, this.size * 0.0004 * this.radius * focal * (name === "anchors" ? 2.2 : 1));
      gl.bindVertexArray(k.vao); gl.drawArrays(gl.POINTS, first, last - first);
    }
  }
}
