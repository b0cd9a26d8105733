// Line charts in SVG with a shared cursor, and flat views on 2-D canvases.
const SVG = "http://www.w3.org/2000/svg";
const CURSORS = [];
function svg(tag, attributes, parent) {
  const el = document.createElementNS(SVG, tag);
  for (const [k, v] of Object.entries(attributes)) el.setAttribute(k, v);
  if (parent) parent.append(el);
  return el;
}

function niceTicks(lo, hi, count) {
  const raw = (hi - lo) / count, power = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = [1, 2, 2.5, 5, 10].find(m => m * power >= raw) * power, out = [];
  for (let v = Math.ceil(lo / step - 1e-9) * step; v <= hi + 1e-9 * step; v += step) out.push(Math.abs(v) < step * 1e-6 ? 0 : v);
  return out;
}
function short(v) {
  const a = Math.abs(v);
  if (a >= 1e6) return v.toExponential(1);
  return String(+v.toFixed(a >= 100 ? 0 : a >= 10 ? 1 : a >= 1 ? 2 : 4));
}

// A pixel column keeps its lowest and highest value, so that no spike is lost.
function thin(xs, ys, columns) {
  if (xs.length <= 2 * columns) return xs.map((x, i) => [x, ys[i]]);
  const out = [], step = xs.length / columns;
  for (let c = 0; c < columns; c++) {
    let lo = -1, hi = -1;
    for (let i = Math.floor(c * step); i < Math.min(Math.floor((c + 1) * step), xs.length); i++) {
      if (ys[i] === null) continue;
      if (lo < 0 || ys[i] < ys[lo]) lo = i;
      if (hi < 0 || ys[i] > ys[hi]) hi = i;
    }
    if (lo < 0) continue;
    for (const i of lo < hi ? [lo, hi] : lo > hi ? [hi, lo] : [lo]) out.push([xs[i], ys[i]]);
  }
  return out;
}

// series: [{name, x, y, colour, low?, high?, dash?}], x in seconds
function lineChart(box, { series, unit, zero, format = short }) {
  const [L, R, T, B] = [52, 8, 20, 24];
  const draw = () => {
    const W = box.clientWidth, H = box.clientHeight;
    if (!W) return;
    box.textContent = "";
    const root = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img" }, box);
    const all = series.flatMap(s => [...s.y, ...(s.low || []), ...(s.high || [])]).filter(v => v !== null && isFinite(v));
    let lo = zero ? 0 : Infinity, hi = -Infinity;
    for (const v of all) { if (v < lo) lo = v; if (v > hi) hi = v; }
    if (!isFinite(hi)) return;
    if (hi - lo < 1e-9) { hi += 0.5 * Math.abs(hi) || 1; if (!zero) lo -= 0.5 * Math.abs(lo) || 1; }
    const [t0, t1] = DATA.time, X = t => L + (t - t0) / (t1 - t0 || 1) * (W - L - R), Y = v => H - B - (v - lo) / (hi - lo) * (H - T - B);
    for (const v of niceTicks(lo, hi, 4)) {
      svg("line", { x1: L, x2: W - R, y1: Y(v), y2: Y(v), stroke: "var(--line)" }, root);
      svg("text", { x: L - 8, y: Y(v) + 4, "text-anchor": "end" }, root).textContent = short(v);
    }
    for (const t of niceTicks(t0, t1, Math.max(2, W / 130))) {
      const label = svg("text", { y: H - 6, "text-anchor": "middle" }, root); label.textContent = short(t) + " s";
      label.setAttribute("x", Math.min(X(t), W - label.getComputedTextLength() / 2));
    }
    svg("text", { x: 0, y: 12 }, root).textContent = unit;
    series.forEach(s => {
      if (s.low) {
        const top = thin(s.x, s.high, W), bottom = thin(s.x, s.low, W).reverse();
        svg("polygon", { points: [...top, ...bottom].filter(p => p[1] !== null).map(([x, y]) => `${X(x).toFixed(1)},${Y(y).toFixed(1)}`).join(" "), fill: s.colour, opacity: 0.16 }, root);
      }
      let path = "", pen = false;
      for (const [x, y] of thin(s.x, s.y, W)) { if (y === null) { pen = false; continue; } path += `${pen ? "L" : "M"}${X(x).toFixed(1)} ${Y(y).toFixed(1)}`; pen = true; }
      svg("path", { d: path, fill: "none", stroke: s.colour, "stroke-width": 1.5, "stroke-linejoin": "round", "stroke-dasharray": s.dash || "none" }, root);
    });
    let at = W - R;
    for (const s of series.length > 1 ? [...series].reverse() : []) {
      const label = svg("text", { x: at, y: 12, "text-anchor": "end", style: `fill:${s.colour}` }, root); label.textContent = s.name;
      at -= 8 * s.name.length + 16;
    }
    const cursor = svg("line", { y1: T, y2: H - B, stroke: "var(--soft)", "stroke-width": 1, visibility: "hidden" }, root);
    const tip = make("div", "", box); tip.className = "tip"; tip.hidden = true;
    const put = (t, label) => {
      cursor.setAttribute("x1", X(t)); cursor.setAttribute("x2", X(t)); cursor.setAttribute("visibility", "visible");
      tip.hidden = !label; if (!label) return;
      const parts = series.map(s => { let i = s.x.findIndex(x => x >= t); if (i < 0) i = s.x.length - 1; const v = s.y[i]; return (series.length > 1 ? s.name + " " : "") + (v === null || v === undefined ? "none" : format(v)); });
      tip.textContent = `${t.toFixed(2)} s: ${parts.join(", ")}`;
      tip.style.left = Math.min(Math.max(X(t) - tip.offsetWidth / 2, 0), W - tip.offsetWidth) + "px";
    };
    box.putCursor = put;
    root.addEventListener("pointermove", e => { const t = t0 + (e.clientX - root.getBoundingClientRect().left - L) / (W - L - R) * (t1 - t0); if (t >= t0 && t <= t1) moveCursor(t, box); });
    root.addEventListener("pointerleave", () => { tip.hidden = true; });
  };
  new ResizeObserver(draw).observe(box); draw();
  CURSORS.push((t, from) => box.putCursor && box.putCursor(t, from === box));
}
function moveCursor(t, from) { for (const f of CURSORS) f(t, from); }

// Orthographic picture of the map: axes a (right) and b (up).
function flatView(canvas, a, b) {
  const ratio = Math.min(devicePixelRatio || 1, 2), W = canvas.width = Math.round(canvas.clientWidth * ratio), H = canvas.height = Math.round(canvas.clientHeight * ratio);
  if (!W || !H) return;
  const g = canvas.getContext("2d"), box = DATA.box, dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const s = 0.92 * Math.min(W / (box.hi[a] - box.lo[a]), H / (box.hi[b] - box.lo[b]));
  const X = v => W / 2 + s * (v - (box.lo[a] + box.hi[a]) / 2), Y = v => H / 2 - s * (v - (box.lo[b] + box.hi[b]) / 2);
  const image = g.createImageData(W, H), px = image.data, back = rgb("--stage").map(v => 255 * v);
  for (let i = 0; i < px.length; i += 4) { px[i] = back[0]; px[i + 1] = back[1]; px[i + 2] = back[2]; px[i + 3] = 255; }
  const ext = EDGES.hi.map((h, k) => h - EDGES.lo[k]);
  for (let i = 0; i < EDGES.n; i++) {
    const x = Math.round(X(EDGES.lo[a] + EDGES.position[3 * i + a] / 65535 * ext[a])), y = Math.round(Y(EDGES.lo[b] + EDGES.position[3 * i + b] / 65535 * ext[b]));
    if (x < 0 || y < 0 || x >= W || y >= H) continue;
    const o = 4 * (y * W + x);
    for (let k = 0; k < 3; k++) { const c = EDGES.colour[3 * i + k]; px[o + k] = 0.45 * px[o + k] + 0.55 * (dark ? c + 0.16 * (255 - c) : 0.85 * c); }
  }
  g.putImageData(image, 0, 0);
  const path = (p, colour, width) => { g.beginPath(); for (let i = 0; i < p.length; i++) g.lineTo(X(p[i][a]), Y(p[i][b])); g.strokeStyle = colour; g.lineWidth = width * ratio; g.lineJoin = "round"; g.stroke(); };
  if (DATA.truth) path(DATA.truth, css("--truth"), 1);
  path(DATA.positions, css("--tracked"), 1.6);
  const length = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find(v => v * s > 60 * ratio) || 100;
  const label = `${length} ${DATA.unit}`;
  g.font = `${13 * ratio}px system-ui, sans-serif`;
  g.fillStyle = css("--glass"); g.fillRect(8 * ratio, H - 38 * ratio, Math.max(length * s, g.measureText(label).width) + 12 * ratio, 30 * ratio);
  g.fillStyle = css("--soft"); g.fillRect(14 * ratio, H - 16 * ratio, length * s, 2 * ratio); g.fillText(label, 14 * ratio, H - 22 * ratio);
}
