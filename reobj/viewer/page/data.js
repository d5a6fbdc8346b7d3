"use strict";
// Data of the page: JSON of write_scene in scene.py. Text enters through text nodes only.
const $ = (id) => document.getElementById(id);
const S = JSON.parse($("data").textContent);
const bytes = (b64) => Uint8Array.from(atob(b64), (c) => c.charCodeAt(0));
const floats = (b64) => new Float32Array(bytes(b64).buffer);
const picture = (b64) => `data:image/jpeg;base64,${b64}`;
const figure = (data, alt, text, more = {}) => el("figure", more, el("img", { src: picture(data), alt }),
  text);
const several = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
const percent = (x) => `${Math.round(100 * x)} %`;
const rgb = (o) => `rgb(${o.color})`;

function el(tag, props = {}, ...children) {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...children);
  return node;
}

function svg(tag, attributes, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

// ---- Small vectors: lists of three numbers ----
const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const times = (a, s) => a.map((x) => x * s);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const cross = (a, b) => [0, 1, 2].map((i) => a[(i + 1) % 3] * b[(i + 2) % 3]
  - a[(i + 2) % 3] * b[(i + 1) % 3]);
const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));
const axesOf = ([w, x, y, z]) => [  // columns of the rotation matrix
  [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
  [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
  [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]];
const some = (list, n) => list.filter((_, i) => i % Math.ceil(list.length / n) === 0);
function quantile(values, share) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.round(share * (sorted.length - 1))];
}

// ---- Numbers as text: the rule is that of `decimals` in files.py ----
const decimals = (sigma) => sigma > 0 && sigma < Infinity
  ? Math.max(0, Math.ceil(-Math.log10(sigma))) : 2;
const withSigma = (value, sigma, unitName) => {
  if (!Number.isFinite(sigma)) return `${+value.toPrecision(3)} ${unitName}`;   // not known
  const digits = decimals(sigma);
  return `${value.toFixed(digits)} ± ${sigma.toFixed(digits)} ${unitName}`;
};
const UNITS = { m: [1, 2], cm: [100, 0], ft: [3.28084, 1] };   // per metre, decimals without a sigma
const unitOf = (metric) => metric ? state.unit : "units";
const perUnit = (metric) => metric ? UNITS[state.unit][0] : 1;
const length = (value, metric) => `${(value * perUnit(metric)).toFixed(metric ? UNITS[state.unit][1] : 2)} ${unitOf(metric)}`;
const lengthWithSigma = (value, sigma, metric) =>
  withSigma(value * perUnit(metric), sigma * perUnit(metric), unitOf(metric));
function sidesOf(o) {                            // texts: value and, where known, sigma
  if (!o.size_m || state.unit === "m") return o.sides;
  const size = o.size_m.map((x) => x * perUnit(true)), sigma = o.size_rel_sigma?.map((s, i) => s * size[i]);
  const digits = sigma && decimals(Math.min(...sigma));
  return size.map((x, i) => sigma ? [x.toFixed(digits), sigma[i].toFixed(digits)] : [`${+x.toPrecision(3)}`]);
}
const sizeText = (o) => o.sides.length
  ? `${sidesOf(o).map(([side]) => side).join(" × ")} ${unitOf(o.size_m)}` : "";

// ---- The selected component in its level frame: z up, 0 on the floor, metres if known ----
const state = { part: -1, step: -1, seat: -1, asked: null, sought: null, session: null, selected: null, ghost: null, hidden: new Set(),
  hiddenKinds: new Set(["not_seen"]), measured: [], unit: "m", hiddenIds: new Set(), only: null };
let objects = S.objects;                         // as the edits have them
let here, solid, steps, cams, posed, level;      // of the part: objects, with a solid, steps, cameras

function levelFrame(part) {                      // from the world of a part
  const { up, scale, floor } = S.parts[part], normal = floor ? floor.normal : up;
  const east = unit(cross(Math.abs(normal[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], normal));
  const rows = [east, cross(normal, east), normal];
  const metres = scale && scale.source !== "none" ? scale.metres_per_unit : null;
  const made = { rows, metres, size: metres || 1, unit: metres ? "m" : "units",
    sigma: metres ? scale.rel_sigma || 0 : 0, floor: Boolean(floor), height: 0 };
  if (floor) made.height = floor.offset * made.size;
  made.turn = (v) => rows.map((r) => dot(r, v));
  made.place = (p) => { const q = times(made.turn(p), made.size); q[2] -= made.height; return q; };
  return made;
}

const pose = floats(S.poses);                    // 12 numbers a step, NaN without a pose
function camera(step) {                          // {right, down, forward, at}, level, or null
  const m = pose.subarray(12 * step, 12 * step + 12);
  if (step < 0 || !(m[0] === m[0]) || !m.length) return null;
  const column = (j) => [m[j], m[4 + j], m[8 + j]];
  return { right: level.turn(column(0)), down: level.turn(column(1)),
    forward: level.turn(column(2)), at: level.place(column(3)) };
}

function pointsOf(part) {                        // level positions, colours
  const place = floats(S.parts[part].points), at = new Float32Array(place.length);
  for (let i = 0; i < place.length; i += 3) at.set(level.place([...place.subarray(i, i + 3)]), i);
  return { at, color: bytes(S.parts[part].colors) };
}

const seenAt = (o, step) => o.seen.some((s, i) => i % 2 === 0 && s <= step
  && step <= o.seen[i + 1]);
const counted = (o) => o.status !== "doubtful" && o.status !== "implausible";  // as in entries.py
function foundText(all) {                        // as in entries.py
  const found = all.filter(counted), shaped = found.filter((o) => o.center).length, rest = found.length - shaped;
  if (found.every((o) => o.status === "tracked")) return several(rest, "object");
  return `${several(shaped, "object")} with a shape${rest ? `, ${rest} without` : ""}`;
}
const allowed = (o) => !state.hiddenIds.has(o.id) && (state.only === null || state.only === o.id)
  && !state.hidden.has(o.class) && !hiddenByKind(changeOf(o))
  && ($("doubtful").checked || o.status !== "doubtful");
const shown = () => solid.filter(allowed);
