// Fills the page from DATA.
byId("title").textContent = DATA.title;
byId("story").textContent = DATA.story;
for (const text of DATA.warnings) make("li", text, byId("warnings"));
byId("foot").textContent = DATA.foot;
for (const t of DATA.tiles) { const li = make("li", undefined, byId("tiles")), b = make("b", t.value, li); if (t.unit) make("small", t.unit, b); make("span", t.label, li); }

const viewer = new Viewer(byId("scene"), v => document.querySelectorAll(".views button").forEach(b => b.setAttribute("aria-pressed", String(b.dataset.view === v.view))));
byId("nogl").hidden = Boolean(viewer.gl);

const TOGGLES = [["edges", "Edges", EDGES.n, "--soft"], ["anchors", "Anchors", ANCHORS.n, "--predicted"], ["trajectory", "Trajectory", 1, "--tracked"], ["cameras", "Cameras", 1, "--accent"], ["truth", "Ground truth", DATA.truth ? 1 : 0, "--truth"], ["grid", "Grid", 1, "--line"]];
for (const [key, label, present, colour] of TOGGLES) {
  if (!present) continue;
  const el = make("label", undefined, byId("toggles")), input = document.createElement("input");
  input.type = "checkbox"; input.id = "show-" + key; input.checked = viewer.show[key];
  el.append(input, label); make("i", undefined, el).style.setProperty("--swatch", `var(${colour})`);
  input.addEventListener("change", () => { viewer.show[key] = input.checked; viewer.request(); });
}

function frustum(i, size) {
  const c = DATA.positions[i], R = DATA.rotations[i], [x, y] = DATA.fov, corners = [[-x, -y], [x, -y], [x, y], [-x, y]].map(([a, b]) => add3(add3(add3(c, R[0], a * size), R[1], b * size), R[2], size));
  const out = [];
  for (let k = 0; k < 4; k++) out.push(...c, ...corners[k], ...corners[k], ...corners[(k + 1) % 4]);
  return out;
}
function paint(n, colour) { const out = []; for (let i = 0; i < n; i++) out.push(...colour); return out; }

function layLines() {
  const colours = STATUS.map(s => rgb("--" + s));
  viewer.setLines("trajectory", { vertices: DATA.positions.flat(), colours: DATA.status.flatMap(s => colours[s]), strip: true });
  if (DATA.truth) viewer.setLines("truth", { vertices: DATA.truth.flat(), colours: paint(DATA.truth.length, rgb("--truth")), strip: true });
  const size = 0.04 * DATA.home.radius, ground = rgb("--stage"), faint = rgb("--accent").map((v, k) => 0.6 * v + 0.4 * ground[k]), frames = DATA.cameras.flatMap(i => frustum(i, size));
  viewer.setLines("cameras", { vertices: frames, colours: paint(frames.length / 3, faint), strip: false });
  const grid = [], { lo, hi } = DATA.box, step = DATA.gridStep, z = DATA.floor;
  for (let x = Math.floor(lo[0] / step) * step; x <= hi[0] + step; x += step) grid.push(x, Math.floor(lo[1] / step) * step, z, x, Math.ceil(hi[1] / step) * step, z);
  for (let y = Math.floor(lo[1] / step) * step; y <= hi[1] + step; y += step) grid.push(Math.floor(lo[0] / step) * step, y, z, Math.ceil(hi[0] / step) * step, y, z);
  viewer.setLines("grid", { vertices: grid, colours: paint(grid.length / 3, rgb("--line")), strip: false });
  setTime(now, false);
}

let now = DATA.positions.length - 1, playing = 0;
function setTime(i, cursor = true) {
  now = Math.max(0, Math.min(DATA.positions.length - 1, i));
  if (viewer.gl && viewer.lines.trajectory) {
    viewer.lines.trajectory.count = now + 1;
    const f = frustum(now, 0.1 * DATA.home.radius);
    viewer.setLines("current", { vertices: f, colours: paint(f.length / 3, rgb("--lost")), strip: false });
    viewer.request(Boolean(playing));
  }
  const t = DATA.stamps[now];
  byId("time").value = Math.round(1000 * now / (DATA.positions.length - 1 || 1)); byId("time-out").textContent = t.toFixed(2) + " s";
  if (cursor) moveCursor(t, null);
}
byId("time").addEventListener("input", e => setTime(Math.round(e.target.value / 1000 * (DATA.positions.length - 1))));
byId("play").addEventListener("click", () => {
  byId("play").textContent = playing ? "Play" : "Pause";
  if (playing) { cancelAnimationFrame(playing); playing = 0; return; }
  if (now >= DATA.positions.length - 1) setTime(0);
  const begin = performance.now() / 1000 - DATA.stamps[now];
  const step = () => {
    const t = performance.now() / 1000 - begin; let i = now;
    while (i < DATA.stamps.length - 1 && DATA.stamps[i] < t) i++;
    setTime(i);
    if (i >= DATA.stamps.length - 1) { playing = 0; byId("play").textContent = "Play"; } else playing = requestAnimationFrame(step);
  };
  playing = requestAnimationFrame(step);
});

document.querySelectorAll(".views button").forEach(b => b.addEventListener("click", () => viewer.gl && viewer.setView(b.dataset.view)));
const MODES = { rgb: 0, height: 1, observations: 2, sigma: 3 };
function legend() {
  const name = byId("colour").value, range = { height: [DATA.height[0], DATA.height[1], DATA.unit], observations: [EDGES.observations[0], EDGES.observations[1], ""], sigma: [EDGES.sigma[1], EDGES.sigma[0], DATA.unit] }[name];
  byId("legend").hidden = !range; if (!range) return;
  byId("legend-low").textContent = `${short(range[0])} ${range[2]}`; byId("legend-high").textContent = `${short(range[1])} ${range[2]}`;
  byId("legend-ramp").style.background = `linear-gradient(90deg, ${RAMP.map(c => `rgb(${c})`).join(",")})`;
}
byId("colour").addEventListener("change", e => { viewer.mode = MODES[e.target.value]; legend(); viewer.request(); });
// Sigma codes are logarithmic between the two ends.
function sigmaLimit() {
  const t = byId("sigma").value / 100, [lo, hi] = EDGES.sigma;
  viewer.sigmaMax = t >= 1 ? 2 : t; byId("sigma-out").textContent = t >= 1 ? "off" : `${short(lo * Math.pow(hi / lo, t))} ${DATA.unit}`; viewer.request();
}
byId("sigma").addEventListener("input", sigmaLimit); sigmaLimit();
byId("size").addEventListener("input", e => { viewer.size = +e.target.value; viewer.request(); });

function flats() { flatView(byId("top"), 0, 1); flatView(byId("side"), 0, 2); band(); }
function band() {
  const c = byId("status"); if (!c.clientWidth) return;
  const W = c.width = c.clientWidth * Math.min(devicePixelRatio || 1, 2), H = c.height = 34, g = c.getContext("2d"), [t0, t1] = DATA.time, t = DATA.stamps;
  const colours = STATUS.map(s => css("--" + s)), X = s => (s - t0) / (t1 - t0 || 1) * W;
  // The rarest status is drawn last: a single lost frame must show.
  for (const s of [2, 1, 0, 3, 4, 5]) for (let i = 0; i < t.length; i++) if (DATA.status[i] === s) { g.fillStyle = colours[s]; g.fillRect(X(t[i]), 0, Math.max(s === 2 ? 1 : 2, X(t[i + 1] ?? t1) - X(t[i]) + 0.5), H); }
}
function row(table, cells, tag = "td") { const tr = make("tr", undefined, table); for (const c of cells) make(tag, c, tr); }

if (DATA.error) {
  byId("s-error").hidden = false; byId("error-note").textContent = DATA.error.note;
  lineChart(byId("error-m"), { series: [{ name: "", x: DATA.error.t, y: DATA.error.cm, colour: "var(--tracked)" }], unit: "position error [cm]", zero: true });
  lineChart(byId("error-deg"), { series: [{ name: "", x: DATA.error.t, y: DATA.error.deg, colour: "var(--tracked)" }], unit: "rotation error [deg]", zero: true });
}
if (DATA.hasStatus) {
  byId("s-status").hidden = false;
  STATUS.forEach((s, k) => { const n = DATA.statusCounts[k]; if (!n) return; const li = make("li", undefined, byId("status-key")); make("i", undefined, li).style.background = `var(--${s})`; li.append(`${s} ${n}`); });
  if (DATA.inliers) lineChart(byId("inliers"), { series: [{ name: "matches", x: DATA.stamps, y: DATA.matches, colour: "var(--truth)" }, { name: "inliers", x: DATA.stamps, y: DATA.inliers, colour: "var(--tracked)" }], unit: "count", zero: true }); else byId("inliers").remove();
  if (DATA.events.length) { row(byId("events"), ["from", "to", "frames", "status", "reason"], "th"); for (const e of DATA.events) row(byId("events"), e); }
}
if (DATA.scale) {
  byId("s-scale").hidden = false; byId("scale-note").textContent = DATA.scale.note;
  lineChart(byId("scale"), { series: [{ name: "scale", x: DATA.stamps, y: DATA.scale.value, low: DATA.scale.low, high: DATA.scale.high, colour: "var(--tracked)" }], unit: "metres per map unit, with 95 % interval" });
}
if (DATA.stages.length) {
  byId("s-stages").hidden = false;
  const most = Math.max(...DATA.stages.map(s => s.p95), 1e-9);
  for (const s of DATA.stages) {
    make("span", s.name, byId("stages")).className = "name"; const bar = make("div", undefined, byId("stages")); bar.className = "bar";
    make("i", undefined, bar).style.width = 100 * s.median / most + "%"; make("u", undefined, bar).style.left = `calc(${100 * s.p95 / most}% - 2px)`;
    make("span", `${s.median.toFixed(1)} / ${s.p95.toFixed(1)} ms`, byId("stages")).className = "num";
  }
}
if (DATA.keyframes.length) {
  byId("s-keyframes").hidden = false;
  for (const k of DATA.keyframes) { const f = make("figure", undefined, byId("keyframes")), img = document.createElement("img"); img.src = k.src; img.alt = k.label; f.append(img); make("figcaption", k.label, f); }
}
if (DATA.mapScore) { byId("s-map").hidden = false; for (const r of DATA.mapScore) row(byId("map-score"), r); }
for (const r of DATA.summary) row(byId("summary"), r);
if (DATA.config) { byId("s-config").hidden = false; byId("config").textContent = DATA.config; }

if (viewer.gl) { layLines(); viewer.onChange(viewer); }
flats();
new ResizeObserver(flats).observe(byId("top"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (viewer.gl) layLines(); flats(); viewer.request(); });
document.documentElement.dataset.ready = "yes";
