// The list of objects and the panel of the chosen one.
const nameOf = (o) => `${o.class} ${o.id}`;
const NOTE = { ok: "", prior_dominated: "", rejected: "no solid", doubtful: "low confidence",
  implausible: "implausible size", tracked: "in 2D only" };

function bar(o) {                                // when the object was seen, over the part's frames
  const first = S.steps.frame[steps[0]], span = S.steps.frame[steps.at(-1)] - first + 1;
  return el("span", { className: "bar" }, ...o.visits.map(([a, b]) => el("span",
    { style: `left: ${100 * (a - first) / span}%; width: ${100 * (b - a + 1) / span}%` })),
  el("span", { className: "head" }));
}

function row(o) {
  const made = el("button", { className: `row ${o.status}`, onclick: () => select(o),
    title: o.reason || o.status.replace("_", " ") }, el("i"), el("b", {}, nameOf(o)),
  el("small", {}, [(o.status === "prior_dominated" ? "≈ " : "") + sizeText(o), S.why_flat ? "" : NOTE[o.status], o.edited ? "edited" : ""]
    .filter(Boolean).map((text) => ` · ${text}`).join("")), ...kindTag(o), ...(o.then ? [] : [bar(o)]));
  made.style.setProperty("--own", rgb(o));
  return made;
}

const bySize = (o) => o.size ? -o.size[0] * o.size[1] * o.size[2] : 0;
const ORDER = {
  id: (a, b) => a.id - b.id,
  name: (a, b) => a.class.localeCompare(b.class) || a.id - b.id,
  size: (a, b) => bySize(a) - bySize(b) || a.id - b.id,
  seen: (a, b) => b.frames_seen - a.frames_seen || a.id - b.id,
  first: (a, b) => a.visits[0]?.[0] - b.visits[0]?.[0] || a.id - b.id,
  change: (a, b) => rankOf(a) - rankOf(b) || a.id - b.id,
};

function filterList() {
  const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const o of here) {
    const text = `${nameOf(o)} ${o.status} ${NOTE[o.status]} ${o.reason} ${kindText(changeOf(o))}`.toLowerCase();
    o.found = words.every((word) => text.includes(word));
    o.row.hidden = !allowed(o) || !o.found;
    o.row.classList.toggle("now", state.step >= 0 && seenAt(o, state.step));
  }
  filterGhosts(words);
  $("none").textContent = words.length ? "no object matches" : "all objects are hidden";
  $("none").hidden = ![...here, ...ghosts.filter(absent)].length
    || [...$("rows").children].some((row) => !row.hidden);
}

function showOnly(hide, only) {                  // ids that are hidden, or the only one that is shown
  Object.assign(state, { hiddenIds: new Set(hide), only });
  const count = state.hiddenIds.size, o = here.find(({ id }) => id === only);
  $("some").hidden = !count && only === null;
  $("some").querySelector("span").textContent = o ? `only ${nameOf(o)} is shown:`
    : `${several(count, "hidden object")}:`;
  filterList();
  redraw();
}
const viewButtons = (o) => el("div", { className: "act" },
  el("button", { title: "hide it in the list and in 3D", onclick: () => {
    select(o);
    showOnly([...state.hiddenIds, o.id], null);
  } }, "Hide"), el("button", { onclick: () => showOnly([], state.only === o.id ? null : o.id) },
    "Show only this"));
$("show-all").onclick = () => showOnly([], null);

function showClasses(names, on) {
  names.forEach((name) => state.hidden[on ? "delete" : "add"](name));
  fillList();
  redraw();
}

function fillList() {
  here.forEach((o) => { o.row = row(o); });
  const listed = [...here, ...ghosts.filter(absent)];
  $("rows").replaceChildren(...listed.sort(ORDER[$("sort").value]).map((o) => o.row));
  fillKinds(listed);
  const names = [...new Set(here.map((o) => o.class))].sort();
  $("classes").querySelector("summary").textContent = `classes (${names.length})`;
  const every = (text, on) => el("button", { onclick: () => showClasses(names, on) }, text);
  $("classes").querySelector("div").replaceChildren(every("all", true), every("none", false), ...names.map((name) => {
    const box = el("input", { type: "checkbox", checked: !state.hidden.has(name), onchange: () => {
      state.hidden[box.checked ? "delete" : "add"](name);
      filterList();
      redraw();
    } });
    const count = here.filter((o) => o.class === name && counted(o)).length;
    return el("label", {}, box, `${name} ${count}`);
  }));
  $("legend").hidden = Boolean(state.session);
  const ends = steps.length ? [steps[0], steps.at(-1)].map(frameOf) : [0, 0];
  $("legend").replaceChildren(el("span", {}, `bars: seen in frames ${ends[0]}`),
    el("span", {}, el("b", {}, "| "), "now"), el("span", {}, `${ends[1]}`));
  const doubtful = here.filter((o) => o.status === "doubtful").length;
  $("notes").replaceChildren(
    ...(doubtful ? [el("p", { className: "dim" }, `${several(doubtful, "object")} of low confidence, `
      + "more likely absent than present: ", el("button", { onclick: () => {
        $("doubtful").checked = !$("doubtful").checked;
        $("doubtful").onchange();
      } }, "show or hide"))] : []),
    ...(S.warnings.length ? [el("p", {}, el("b", {}, "Notes"))] : []),
    ...S.warnings.map((text) => el("p", { className: "dim" }, text)));
  filterList();
}

const AND = new Intl.ListFormat("en-GB");        // 1, 2 and 3
function evidence(link) {
  const numbers = [...new Set(link.tracklets)];
  const noun = numbers.length > 1 ? "tracklets" : "tracklet";
  const owners = (t) => { const ids = objects.filter((o) => o.tracks.includes(t)).map((o) => o.id);
    return `${ids.length > 1 ? "objects" : "object"} ${AND.format(ids.map(String))}`; };
  const names = `${noun} ${numbers.map((t) => `${t} (${owners(t)})`).join(", ")}`;
  if (link.place_iou === null) {
    return (link.kind === "split" ? `split: ${names} from the rest`
      : `merge of ${names}`) + ` by appearance alone (log odds ${link.appearance_log_odds})`;
  }
  if (link.kind === "split") {
    return `split: parts of ${names} are at different 3D positions (overlap ${link.place_iou})`;
  }
  return `merge of ${names}: overlap in 3D ${link.place_iou}, log odds of the appearance ${link.appearance_log_odds}`
    + (link.kept ? "" : "; undone: one solid does not fit the boxes of both");
}

function directionFacts(o) {                     // of cameras that turn on one spot
  const away = level.turn(o.direction), spot = [0, 1, 2].map((i) => quantile(posed.map((c) => c.at[i]), 0.5));
  const [first, now] = [posed[0].forward, away].map(([x, y]) => Math.atan2(y, x));
  const turned = (180 / Math.PI * (first - now) + 540) % 360 - 180, up = 180 / Math.PI * Math.asin(away[2]);
  return [["direction", `${Math.abs(turned).toFixed()}° ${turned < 0 ? "left" : "right"} of the first view, `
    + `${Math.abs(up).toFixed()}° ${up < 0 ? "down" : "up"}`],
  ["distance", `≈ ${length(Math.hypot(...add(level.place(o.center), spot, -1)), level.metres)}, guessed from the category`]];
}

function facts(o) {
  const { scale } = S.parts[o.part], unitName = unitOf(o.size_m), sides = sidesOf(o);
  const rows = o.then ? [["recording", `${o.then.name}, ${dateOf(o.then)} UTC`], ["now", nowOf(o)]]
    : [["status", o.status.replace("_", " ") + (o.reason ? `: ${o.reason}` : "")]];
  ["width", "depth", "height"].forEach((name, i) => { if (o.sides.length) rows.push(
    [name, `${sides[i].join(" ± ")} ${unitName}`
      + (o.size_rel_sigma ? ` (${percent(o.size_rel_sigma[i])})` : "")]); });
  if (o.sides.length) rows.push(
    ["scale", scale && scale.source !== "none" ? `from ${scale.source.replace("_", " ")}, ± `
      + percent(scale.rel_sigma || 0) : "unknown"], ["shape", o.support]);
  rows.push(...changeFacts(changeOf(o)));
  if (o.then) return rows;
  if (o.confidence !== null) rows.push(["confidence", percent(o.confidence)]);
  const [, second] = Object.entries(o.classes);
  if (second && second[1] >= 0.05) rows.push(["class", Object.entries(o.classes)
    .map(([name, p]) => `${name} ${percent(p)}`).join(", ")]);
  rows.push(["seen", `frames: ${o.frames_seen}, visits: ${o.visits.length}`], ["score", o.score]);
  if (o.angular_size_deg) rows.push(["angular size", `${o.angular_size_deg}°`]);
  if (o.direction && posed.length) rows.push(...directionFacts(o));
  if (o.parallax_deg !== null) rows.push(["parallax", `${o.parallax_deg}°`]);
  if (o.reprojection_iou_median !== null) rows.push(["box overlap", o.reprojection_iou_median]);
  if (o.dropped_boxes) rows.push(["boxes left out", o.dropped_boxes]);
  return rows;
}

function select(o) {
  if (state.merging && o && o !== state.merging) {
    edit(edits.merge(state.merging, o));
    return;
  }
  if (!state.merging) hint("");
  state.selected = o === state.selected ? null : o;  // a second time: no more
  state.ghost = null;
  markGhostRow();
  here.forEach((x) => x.row.classList.toggle("selected", x === state.selected));
  $("panel").replaceChildren();
  redraw();
  if (!state.selected) return;
  o.row.scrollIntoView({ block: "nearest" });
  const links = S.links.filter((l) => l.tracklets.some((t) => o.tracks.includes(t)));
  const crop = ([frame, data]) => figure(data, `${o.class} in frame ${frame}`, `${frame}`,
    { onclick: () => goTo(S.steps.frame.findLastIndex((f) => f <= frame)) });
  $("panel").style.setProperty("--own", rgb(o));
  $("panel").append(
    el("button", { id: "close", title: "close (Esc)", onclick: () => select(o) }, "×"),
    el("h2", {}, el("i"), nameOf(o)), ...(o.then ? [] : [bar(o)]), ...beforeAfter(o.id, o),
    el("div", { className: "crops" }, ...o.crops.map(crop)),
    el("dl", {}, ...facts(o).flatMap(([k, v]) => [el("dt", {}, k), el("dd", {}, v)])),
    ...(o.center ? [viewButtons(o)] : []),
    ...(o.then ? [] : [...editButtons(o), ...visitRows(o)]),
    ...(links.length ? [el("h3", {}, "Merges and splits"),
      el("ul", {}, ...links.map((l) => el("li", {}, evidence(l))))] : []));
  fillCut();
}
