"use strict";
// What report.py packed: JSON, and two point clouds of 11 bytes a point.
const DATA = JSON.parse(document.getElementById("data").textContent);

function bytes(id) {
  const text = atob(document.getElementById(id).textContent.trim());
  const out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out;
}

// Cloud layout: all positions (3 x uint16), then all colours (3 x uint8), then sigma codes, then observation codes.
function cloud(id, meta) {
  const raw = bytes(id), n = meta.count;
  return {
    n, lo: meta.lo, hi: meta.hi, sigma: meta.sigma, observations: meta.observations,
    position: new Uint16Array(raw.buffer, 0, 3 * n),
    colour: raw.subarray(6 * n, 9 * n),
    sigmaCode: raw.subarray(9 * n, 10 * n),
    obsCode: raw.subarray(10 * n, 11 * n),
    xyz(i) { return [0, 1, 2].map(k => this.lo[k] + this.position[3 * i + k] / 65535 * (this.hi[k] - this.lo[k])); },
  };
}

const EDGES = cloud("edges-data", DATA.edges);
const ANCHORS = cloud("anchors-data", DATA.anchors);

function css(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }
function rgb(name) {
  const hex = css(name).replace("#", "");
  return [0, 2, 4].map(k => parseInt(hex.slice(k, k + 2), 16) / 255);
}
function make(tag, text, parent) {
  const el = document.createElement(tag);
  if (text !== undefined) el.textContent = text;
  if (parent) parent.append(el);
  return el;
}
const byId = id => document.getElementById(id);
const STATUS = ["starting", "initialised", "tracked", "relocalised", "predicted", "lost"];

// Perceptually even ramp from dark blue over green to yellow (viridis, 9 of its colours).
const RAMP = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];
function ramp(t) {
  const x = Math.min(Math.max(t, 0), 1) * (RAMP.length - 1), i = Math.min(Math.floor(x), RAMP.length - 2);
  return [0, 1, 2].map(k => Math.round(RAMP[i][k] + (RAMP[i + 1][k] - RAMP[i][k]) * (x - i)));
}
