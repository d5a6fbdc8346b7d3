// Changes since a map: kinds of objects, ghosts at former places, arrows from there.
const RANK = ["moved", "gone", "new", "stayed", "not_seen"];
const kindsOf = (changes) => new Map(RANK.flatMap((kind) => (changes?.[kind] || [])
  .map((c) => [c.id, { ...c, kind }])));
const SINCE = kindsOf(S.changes);                // of this recording
let CHANGES = SINCE;                             // of the recording whose objects are shown
let ghosts = [];                                 // former places in the part: of moved, gone, not seen

// An object has the change of the first of its numbers; a ghost that of its own.
const changeOf = (o) => CHANGES.get((o.ids || [o.id]).find((id) => CHANGES.has(id)));
const rankOf = (o) => changeOf(o) ? RANK.indexOf(changeOf(o).kind) : RANK.length;
const kindText = (c) => c ? c.kind.replace("_", " ") + (c.kind === "moved" && c.distance_m !== null
  ? ` ${length(c.distance_m, true)}` : "") : "";
const markOf = (o) => $("changes").checked && ["moved", "new"].includes(changeOf(o)?.kind)
  ? kindText(changeOf(o)) : "";
const hiddenByKind = (c) => $("changes").checked && state.hiddenKinds.has(c?.kind);
const kindTag = (o) => $("changes").checked && changeOf(o) && changeOf(o).kind !== "stayed"
  ? [el("small", { className: changeOf(o).kind }, " · ",
    el("span", { className: "kind" }, kindText(changeOf(o))))] : [];

function changeFacts(c) {                        // rows of the panel
  if (!c) return [];
  const text = c.kind === "moved" && c.distance_m !== null && c.sigma_m
    ? `moved ${lengthWithSigma(c.distance_m, c.sigma_m, true)}` : kindText(c);
  return [[state.session ? "change" : "since the map", text], ...(c.evidence ? [["evidence", c.evidence]] : []),
    ...(c.candidates.length ? [["may also be", c.candidates.join(", ")]] : [])];
}

// ---- Ghosts ----
const absent = (g) => !g.object;                 // gone or not seen; else the former place of an object
const allowedGhost = (g) => $("changes").checked && !state.hidden.has(g.class)
  && !hiddenByKind(g) && (!g.object || allowed(g.object));
const absentHere = () => ghosts.filter((g) => absent(g) && g.at && allowedGhost(g));

function gatherGhosts() {
  ghosts = [...CHANGES.values()].filter((c) => inMap(state.part) && ["moved", "gone", "not_seen"].includes(c.kind))
    .map((c) => ({ ...c, ...c.from_shape, size: null, frames_seen: 0, visits: [], center: c.from && add(c.from, S.parts[state.part].origin, -1),
      object: here.find((o) => o.ids.includes(c.id) && changeOf(o)?.id === c.id) || null }))
    .filter((g) => g.kind !== "moved" || g.object?.center);
  for (const g of ghosts.filter(absent)) g.row = ghostRow(g);
}

const colorOf = (kind) => { const hex = css(`--${kind === "moved" ? "moved" : "gone"}`).slice(1);
  return [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16)); };

function arrow(from, to) {                       // above all else: points would hide it
  const along = add(to, from, -1), length = Math.hypot(...along);
  if (!length) return [];
  const d = unit(along), head = Math.min(room.radius / 22, length / 2), color = css("--moved");
  const u = unit(cross(Math.abs(d[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], d)), w = cross(u, d);
  const shaft = lines([...from, ...add(to, d, -head)], color, 3.5);
  const tip = new THREE.Mesh(new THREE.CylinderGeometry(0, 0.4, 1, 24),
    new THREE.MeshBasicMaterial({ color, transparent: true, depthTest: false }));
  const at = add(to, d, -head / 2);
  tip.matrixAutoUpdate = false;
  tip.matrix.set(...[0, 1, 2].flatMap((i) => [head * u[i], head * d[i], head * w[i], at[i]]), 0, 0, 0, 1);
  shaft.material.depthTest = false;
  shaft.renderOrder = tip.renderOrder = 3;
  return [shaft, tip];
}

function fillGhosts() {
  clear(former);
  for (const g of ghosts) {
    Object.assign(g, { color: colorOf(g.kind), at: g.center && level.place(g.center), group: null });
    if (g.center && g.half_axes) former.add(solidOf(g));
    g.arrow = g.kind === "moved" && g.at ? arrow(g.at, g.object.at) : [];
    if (g.arrow.length) former.add(...g.arrow);
  }
}

function drawGhosts(inside) {
  for (const g of ghosts) {
    const visible = allowedGhost(g), chosen = g === state.ghost, found = isFound(g.object || g);
    g.arrow.forEach((node) => { node.visible = visible && found; });
    if (!g.group) continue;
    const { wire, halo, faces, ellipsoid } = g.group.parts;
    g.group.visible = visible;
    ellipsoid.visible = halo.visible = false;
    wire.material.linewidth = chosen ? 4 : 2;
    wire.material.opacity = found ? 1 : FAINT;
    faces.material.opacity = (inside ? 0.05 : 0.13) * (found ? 1 : FAINT);
  }
}

function choose(x, y) {                          // a click: objects before ghosts
  const found = pick(x, y);
  const hit = found ? [] : aim(x, y, ghosts.filter((g) => g.group && allowedGhost(g)));
  const ghost = hit[0]?.object.object;
  if (ghost && absent(ghost)) selectGhost(ghost);
  else select(ghost ? ghost.object : found);
}

function selectGhost(g) {                        // a second time: no more
  const again = g === state.ghost;
  if (state.selected || again) select(null);
  if (again) return;
  state.ghost = g;
  $("panel").style.setProperty("--own", "transparent");
  $("panel").replaceChildren(
    el("button", { id: "close", title: "close (Esc)", onclick: () => selectGhost(g) }, "×"),
    el("h2", { className: `ghost ${g.kind}` }, el("i"), nameOf(g)), ...beforeAfter(g.id, null),
    el("dl", {}, ...changeFacts(g).flatMap(([k, v]) => [el("dt", {}, k), el("dd", {}, v)])));
  markGhostRow();
  redraw();
}

// ---- In the list ----
function markGhostRow() {
  for (const g of ghosts.filter(absent)) g.row.classList.toggle("selected", g === state.ghost);
}

function ghostRow(g) {
  return el("button", { className: `row absent ${g.kind}`, title: g.evidence,
    onclick: () => selectGhost(g) }, el("i"), el("b", {}, nameOf(g)), ...kindTag(g));
}

function filterGhosts(words) {
  for (const g of ghosts.filter(absent)) {
    const text = `${nameOf(g)} ${kindText(g)}`.toLowerCase();
    g.found = words.every((word) => text.includes(word));
    g.row.hidden = !allowedGhost(g) || !g.found;
  }
  markGhostRow();
}

function fillKinds(listed) {                     // boxes that hide a kind of change
  const counts = RANK.map((kind) => [kind, listed.filter((o) => changeOf(o)?.kind === kind).length]);
  $("kinds").replaceChildren(...counts.filter(([, count]) => count).map(([kind, count]) => {
    const box = el("input", { type: "checkbox", checked: !state.hiddenKinds.has(kind), onchange: () => {
      state.hiddenKinds[box.checked ? "delete" : "add"](kind);
      filterList();
      redraw();
    } });
    return el("label", { className: kind }, box,
      el("span", { className: "kind" }, `${kind.replace("_", " ")} ${count}`));
  }));
  $("kinds").hidden = !$("changes").checked || !$("kinds").children.length;
}

function startChanges() {                        // a page without a map has none of it
  if (!S.changes) return;
  $("since").textContent = S.changes.summary;
  $("since").hidden = false;
  if (!SINCE.size) return;
  $("changes-label").hidden = false;
  $("changes").onchange = () => { if (state.ghost) select(null); fillList(); redraw(); };
  $("sort").prepend(el("option", { value: "change" }, "by change"));
  $("sort").value = "change";
}
