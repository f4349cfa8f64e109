"use strict";
// What the page of a mesh and the page of a view have in common: vectors, sides of the patient, lengths of a scale.
const find = (id) => document.getElementById(id);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const size = Math.hypot(...a); return a.map((value) => value / size); };
const element = (kind, text, more) => Object.assign(document.createElement(kind), { textContent: text || "" }, more);

const VIEW_NAMES = { A: "anterior", P: "posterior", L: "left", R: "right", S: "superior", I: "inferior" };

// Letters of a direction in LPS, the largest component first.
function sideOf(direction) {
  const letters = ["RL", "AP", "IS"].map((pair, axis) => [Math.abs(direction[axis]), pair[+(direction[axis] > 0)]]);
  return letters.filter(([size]) => size > 0.3).sort((a, b) => b[0] - a[0]).map(([, letter]) => letter).join("");
}

// The longest round length of at most so many mm.
function roundLength(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return power * [5, 2, 1].find((factor) => factor * power <= most);
}

const sayPlace = (point) => point.map((value) => (Math.round(10 * value) / 10 || 0).toFixed(1)).join(", ");  // no -0.0
const sayLength = (mm) => `${mm >= 1 ? mm : mm.toPrecision(1)} mm`;
const sayMl = (ml) => (ml === null ? "" : `${ml.toPrecision(ml < 1 ? 2 : 4)} ml`);
