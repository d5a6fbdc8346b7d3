// The measuring tool: two clicks on solids or points; the distance with its standard deviation.
function setMeasure(on) {
  state.measuring = on;
  state.measured = [];
  press("measure", on);
  document.body.classList.toggle("measuring", on);
  hint(on ? `${touch ? "tap" : "click"} two points on shapes or sparse points` : "");
  redraw();
}

function jacobian(o, at) {                       // (3, 9) of a place on a solid by its parameters:
  const local = add(at, o.at, -1), rows = [[], [], []];  // centre, log half axes, turn (of its axes)
  const units = o.axes.map(unit), across = units.map((u) => dot(u, local));
  for (let k = 0; k < 3; k++) {
    const turned = cross([0, 1, 2].map((i) => +(i === k)), across);  // in the object's axes
    for (let i = 0; i < 3; i++) {
      rows[i][k] = level.rows[i][k] * level.size;
      rows[i][3 + k] = units[k][i] * across[k];
      rows[i][6 + k] = dot(units.map((u) => u[i]), turned);
    }
  }
  return rows;
}

function variance(rows, cov, along) {            // of J p along a direction
  const g = [...Array(9).keys()].map((k) => rows.reduce((s, row, i) => s + along[i] * row[k], 0));
  return g.reduce((s, a, i) => s + g.reduce((t, b, j) => t + a * b * cov[9 * i + j], 0), 0);
}

function distanceOf([a, b]) {                    // [value, sigma] in the level frame's unit
  const value = Math.hypot(...add(a.at, b.at, -1)), along = unit(add(b.at, a.at, -1));
  let total = (value * level.sigma) ** 2;
  if (a.object && a.object === b.object) {       // one solid: its place does not matter
    const [p, q] = [a, b].map((end) => jacobian(a.object, end.at));
    const rows = p.map((row, i) => row.map((x, k) => q[i][k] - x));
    total += variance(rows, floats(a.object.cov), along);
  } else {
    for (const end of [a, b]) total += end.object
      ? variance(jacobian(end.object, end.at), floats(end.object.cov), along)
      : ((S.parts[state.part].point_sigma || 0) * level.size) ** 2;
  }
  return [value, Math.sqrt(total)];
}

const REACH_PX = 9;                              // of a click from a point
function placeUnder(x, y) {                      // the nearest of solids and points there
  const cam = viewpoint(), found = [];
  const hit = aim(x, y)[0];
  if (hit) found.push({ at: hit.point.toArray(), object: hit.object.object,
    depth: project(hit.point.toArray(), cam)[2] });
  const at = cloud.visible ? cloud.geometry.attributes.position.array : [];
  let best = null;
  for (let i = 0; i < at.length; i += 3) {
    const place = [at[i], at[i + 1], at[i + 2]], seen = project(place, cam);
    if (!seen) continue;
    const gap = Math.hypot(seen[0] - x, seen[1] - y);
    if (gap < REACH_PX && (!best || gap < best.gap)) best = { at: place, depth: seen[2], gap };
  }
  if (best) found.push(best);
  return found.sort((a, b) => a.depth - b.depth)[0] || null;
}

function measureAt(x, y) {
  const place = placeUnder(x, y);
  if (!place) { hint(`nothing there: ${touch ? "tap" : "click"} a shape or a point`); return; }
  state.measured = state.measured.length === 1 ? [state.measured[0], place] : [place];
  hint(state.measured.length === 1 ? "and the other end" : "");
  redraw();
}

function drawMeasure(cam) {
  $("drawn").querySelectorAll(".measure").forEach((node) => node.remove());
  const ends = state.measured.map(({ at }) => project(at, cam));
  if (ends.some((end) => !end)) return;
  const group = svg("g", { class: "measure" });
  if (ends.length === 2) {
    const [[x1, y1], [x2, y2]] = ends;
    group.append(svg("line", { class: "rule", x1, y1, x2, y2 }),
      svg("text", { x: (x1 + x2) / 2, y: (y1 + y2) / 2 - 8 },
        lengthWithSigma(...distanceOf(state.measured), level.metres)));
  }
  group.append(...ends.map(([cx, cy]) => svg("circle", { class: "tip", cx, cy, r: 4 })));
  $("drawn").append(group);
}
