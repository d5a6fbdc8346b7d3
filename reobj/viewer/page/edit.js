// Manual corrections: a list, shown immediately, saved as edits.json (docs/scene.md).
const pending = [], takenBack = new Set();       // edits made here; numbers of earlier ones undone
let saved = true;

const middle = (list) => list[Math.floor(list.length / 2)];
const refOf = (o, stays = () => true) => {       // an object is named by a box, one that it keeps
  const kept = o.refs.filter(stays), [frame, , ...box] = middle(kept.length ? kept : o.refs);
  return { id: o.id, frame, box };
};
const edits = {
  merge: (a, b) => ({ do: "merge", object: refOf(a), with: refOf(b) }),
  split: (o, frames) => ({ do: "split", frames,
    object: refOf(o, ([frame]) => frame < frames[0] || frames[1] < frame) }),
  splitTracklet: (o, number) => {
    const [frame, , ...box] = middle(o.refs.filter(([, tracklet]) => tracklet === number));
    return { do: "split", object: refOf(o, ([, tracklet]) => tracklet !== number),
      visits: [{ frame, box }] };
  },
  rename: (o, name) => ({ do: "rename", object: refOf(o), class: name }),
  delete: (o) => ({ do: "delete", object: refOf(o) }),
};

// ---- Objects after the edits; `objects OUT --edits` fits their shapes again ----
function stepsOf(visits) {                       // first, last, first, last ... position seen
  const runs = [];
  S.steps.frame.forEach((frame, step) => {
    if (!visits.some(([first, last]) => first <= frame && frame <= last)) return;
    if (runs.at(-1) === step - 1) runs[runs.length - 1] = step; else runs.push(step, step);
  });
  return runs;
}
function joined(spans) {                         // visits: short gaps belong to them
  const made = [];
  for (const [a, b] of [...spans].sort(([p], [q]) => p - q)) {
    const last = made.at(-1);
    if (last && a - last[1] <= S.visit_gap) last[1] = Math.max(last[1], b); else made.push([a, b]);
  }
  return made;
}
const clip = ([a, b], [first, last]) => a <= last && first <= b
  ? [[Math.max(a, first), Math.min(b, last)]] : [];
const cutOut = ([a, b], [first, last]) => [[a, Math.min(b, first - 1)], [Math.max(a, last + 1), b]]
  .filter(([x, y]) => x <= y);
const pairs = (flat) => flat.flatMap((_, i) => i % 2 ? [] : [flat.slice(i, i + 2)]);
const hue = (id) => {                            // `object_color` in types.py
  const [s, v] = [(200 - 60 * (id % 2)) / 255, 255 - 45 * ((id >> 1) % 2)];
  return [5, 3, 1].map((n) => { const k = (n + 6 * (id * 0.381966 % 1)) % 6;
    return Math.round(v - v * s * Math.max(0, Math.min(k, 4 - k, 1))); });
};
const sure = (o) => o.status !== "doubtful" ? {}
  : { status: o.direction ? "prior_dominated" : o.center ? "ok" : "tracked", reason: "" };
const NO_SOLID = { center: null, direction: null, half_axes: null, size: null, size_m: null, sides: [],
  status: "tracked", reason: SERVED ? "its shape is fitted by Save" : "its shape is fitted by objects OUT --edits" };

const APPLY = {
  merge(list, { object, with: other }) {
    const [kept, gone] = [object.id, other.id].sort((a, b) => a - b)
      .map((id) => list.find((o) => o.id === id));
    const large = kept.frames_seen >= gone.frames_seen ? kept : gone;
    const base = kept.center || !gone.center ? kept : gone;
    const both = (key) => [...kept[key], ...gone[key]].sort((a, b) => a[0] - b[0]);
    const tracklets = both("tracklets").sort((a, b) => a[1] - b[1]);
    const made = { ...base, ...sure(base), id: kept.id, color: kept.color, class: large.class,
      visits: joined(both("visits")), tracklets, crops: both("crops"), refs: both("refs"),
      frames_seen: kept.frames_seen + gone.frames_seen,
      seen: stepsOf([...pairs(kept.seen), ...pairs(gone.seen)].map((run) => run.map(frameOf))),
      tracks: [...kept.tracks, ...gone.tracks], ids: [...kept.ids, ...gone.ids],
      sources: [...kept.sources, ...gone.sources], edited: true };
    return list.filter((o) => o !== gone).map((o) => o === kept ? made : o);
  },
  split(list, { object, frames, visits }) {
    const o = list.find(({ id }) => id === object.id), id = Math.max(...list.map((x) => x.id)) + 1;
    const [off, rest] = frames ? splitAt(o, frames) : splitTracklets(o, visits);
    return [...list.map((x) => x === o ? { ...o, ...rest } : x),
      { ...o, ...NO_SOLID, ...off, id, color: hue(id), ids: [] }];
  },
  rename: (list, { object, class: name }) => list.map((o) => o.id === object.id
    ? { ...o, ...sure(o), class: name, edited: true } : o),
  delete: (list, { object }) => list.filter((o) => o.id !== object.id),
};

function partOf(o, tracklets, inside, spans) {   // what a split leaves of an object
  const long = (list) => list.reduce((s, [a, b]) => s + b - a + 1, 0);
  return { tracklets, visits: spans, edited: true, crops: o.crops.filter(inside),
    refs: o.refs.filter(inside), tracks: [...new Set(tracklets.map(([number]) => number))],
    frames_seen: Math.round(o.frames_seen * long(spans) / long(o.visits)) };
}
function splitAt(o, frames) {                    // the frames first to last, and the others
  const within = ([frame]) => frames[0] <= frame && frame <= frames[1];
  return [clip, cutOut].map((cut) => {
    const spans = o.visits.flatMap((span) => cut(span, frames));
    const tracklets = o.tracklets.flatMap(([number, ...span]) => cut(span, frames)
      .map((kept) => [number, ...kept]));
    const runs = pairs(o.seen).flatMap((run) => cut(run.map(frameOf), frames));
    return { ...partOf(o, tracklets, cut === clip ? within : (item) => !within(item), spans),
      seen: stepsOf(runs) };
  });
}
function splitTracklets(o, visits) {             // the tracklets of these boxes, and the others
  const numbers = visits.map((v) => o.refs.find(([frame, , ...box]) => v.frame === frame
    && v.box.every((x, i) => x === box[i]))?.[1]);
  return [true, false].map((off) => {
    const tracklets = o.tracklets.filter(([number]) => numbers.includes(number) === off);
    const spans = joined(tracklets.map(([, a, b]) => [a, b]));
    const made = partOf(o, tracklets, ([frame]) => spans.some(([a, b]) => a <= frame && frame <= b), spans);
    return { ...made, refs: o.refs.filter(([, number]) => numbers.includes(number) === off),
      seen: stepsOf(tracklets.map(([, a, b]) => [a, b])) };
  });
}

function replay() {                              // from the objects of the page
  const chosen = state.selected?.id;
  objects = pending.reduce((list, edit) => APPLY[edit.do](list, edit),
    S.objects.map((o) => ({ ...o, ids: [o.id], sources: [o.id] })));
  Object.assign(state, { selected: null, merging: null, measured: [] });
  gather();
  if (renderer) fillSolids();
  fillList();
  select(here.find((o) => o.id === chosen) || null);
  fillEdits();
}

function edit(made) {
  const [a, b] = [made.object, made.with].map((ref) => objects.find((o) => o.id === ref?.id));
  const both = b ? S.steps.frame.filter((_, step) => seenAt(a, step) && seenAt(b, step)).length : 0;
  pending.push(made);
  saved = false;
  replay();
  hint(both ? `both are seen in ${both} frames at once: are they one object? Undo takes it back` : "");
}
function undo() {
  if (!pending.pop()) return;
  saved = !pending.length && !takenBack.size;
  replay();
}

// ---- The list of edits, and the file ----
const said = (e) => ({
  merge: () => `merge ${e.object.id} with ${e.with.id}`,
  split: () => e.frames ? `split frames ${e.frames.join("–")} off ${e.object.id}`
    : `split ${several(e.visits.length, "tracklet")} off ${e.object.id}`,
  rename: () => `rename ${e.object.id} to ${e.class}`,
  delete: () => `delete ${e.object.id}`,
})[e.do]();

function fillEdits() {
  const bar = $("edits"), earlier = S.edits.map((e, i) => el("li",
    { className: takenBack.has(i) ? "undone" : "dim" }, `${said(e)} (applied) `,
    el("button", { title: SERVED ? "undo with Save" : "undo; visible after the next fit", onclick: () => {
      takenBack[takenBack.has(i) ? "delete" : "add"](i);
      saved = false;
      fillEdits();
    } }, takenBack.has(i) ? "keep" : "×")));
  bar.hidden = !pending.length && !S.edits.length && !job.undo && !job.text;
  const changed = pending.length || takenBack.size;
  bar.replaceChildren(el("b", {}, "Corrections"),
    el("ol", {}, ...earlier, ...pending.map((e) => el("li", {}, said(e)))),
    el("span", { id: "job", hidden: !job.text, className: job.failed ? "fault" : "dim" }, job.text),
    el("button", { id: "undo", disabled: !pending.length || job.running, onclick: undo }, "Undo"),
    ...(SERVED ? [el("button", { id: "undo-saved", disabled: !job.undo || changed || job.running,
      title: "restore the result before the last saved corrections",
      onclick: () => send("undo", "") }, "Undo the last save")] : []),
    el("button", { id: "save", className: "main", disabled: !changed || job.running, onclick: save },
      SERVED ? "Save" : "Save edits.json"));
  bar.querySelector("ol").scrollTop = 1e6;       // the latest one
}

const editsFile = () => JSON.stringify({ format: "reobj-edits", version: 1, map: S.map,
  edits: [...S.edits.filter((_, i) => !takenBack.has(i)), ...pending] }, null, 1) + "\n";

// ---- Served: the corrections are applied at once ----
let job = SERVED ? SERVED.state : {};            // {running, failed, text, undo, version}
const refused = (answer) => answer.text().then((text) => Promise.reject(new Error(text.trim())));
const answered = (answer) => answer.ok ? answer.json() : refused(answer);

function failed(error) {
  job = { ...job, running: false, failed: true, text: error.message };
  fillEdits();
}
function send(what, body) {                      // "edits" or "undo"
  fetch(`${what}?version=${SERVED.state.version}`, { method: "POST", body }).then(answered)
    .then((state) => { job = state; watchJob(); }).catch(failed);
}
function watchJob() {                            // until the result is new; the page is then read again
  fillEdits();
  if (job.running) {
    setTimeout(() => fetch("state").then(answered).then((state) => { job = state; watchJob(); })
      .catch(failed), 300);
  } else if (!job.failed) {
    saved = true;
    location.reload();
  }
}

function save() {
  if (SERVED) { send("edits", editsFile()); return; }
  const url = URL.createObjectURL(new Blob([editsFile()], { type: "application/json" }));
  el("a", { href: url, download: "edits.json" }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
  saved = true;
  $("saved").replaceChildren(el("h2", {}, "edits.json"),
    el("p", {}, "The browser has saved edits.json among your downloads. Run this command in the folder of "
      + "the downloads: it makes objects, shapes and this page again."),
    el("p", {}, el("code", {}, `${S.command || "reobj-track objects OUT"} --edits edits.json`)),
    el("p", { className: "dim" }, "The output folder keeps the corrections: later fits apply them again."),
    el("div", { className: "act" }, el("button", { className: "main",
      onclick: () => $("saved").close() }, "OK")));
  $("saved").showModal();
}
addEventListener("beforeunload", (e) => { if (!saved) e.preventDefault(); });

// ---- The buttons in an object's panel ----
function renameForm(o) {
  const names = [...new Set(S.objects.map((x) => x.class))].sort();
  const input = el("input", { type: "text", value: o.class, maxLength: 60 });
  input.setAttribute("list", "class-names");
  input.setAttribute("aria-label", "class");
  const form = el("form", { className: "act", onsubmit: (e) => {
    e.preventDefault();
    if (input.value.trim()) edit(edits.rename(o, input.value.trim()));
  } }, input, el("datalist", { id: "class-names" }, ...names.map((value) => el("option", { value }))),
  el("button", {}, "Rename"));
  return form;
}

function editButtons(o) {
  if (!o.refs.length) return [el("p", { className: "dim" },
    "No box of it is on this page: save the corrections before the next one of this object.")];
  const act = el("div", { className: "act" }), form = renameForm(o);
  form.hidden = true;
  act.append(
    el("button", { title: "it is the same as another object", onclick: () => {
      state.merging = state.merging ? null : o;    // a second time: none
      hint(state.merging ? `${touch ? "tap" : "click"} the object that is the same as ${nameOf(o)}; `
        + `none: ${touch ? "" : "Esc, or "}“Merge with” again` : "");
    } }, "Merge with …"),
    el("button", { onclick: () => { form.hidden = false; form.querySelector("input").select(); } },
      "Rename …"),
    el("button", { title: "false positive (Delete)", onclick: () => edit(edits.delete(o)) },
      "Delete"));
  return [el("h3", {}, "Correct it"), act, form];
}

const stepAt = (frame) => Math.max(S.steps.frame.findLastIndex((f) => f <= frame), 0);
function spanRow(o, [first, last], text, ...buttons) {
  const inside = o.refs.filter(([frame]) => first <= frame && frame <= last);
  const frame = inside.length ? middle(inside)[0] : first;
  return el("div", { className: "visit" }, el("span", {}, text), el("span", {},
    el("button", { onclick: () => goTo(stepAt(frame)) }, "show"), ...buttons.flatMap((b) => [" ", b])));
}

function visitRows(o) {                          // times in view; under "tracklets" their tracks
  const splitButton = (text, title, made) => el("button", { title, onclick: () => edit(made()) }, text);
  const end = o.visits.at(-1)[1];
  const rows = o.visits.map((visit, i) => spanRow(o, visit, `${visit[0]}–${visit[1]}`,
    ...(o.visits.length > 1 ? [splitButton("split off", "this visit alone shows another object",
      () => edits.split(o, visit))] : []),
    ...(i > 0 && i < o.visits.length - 1 ? [splitButton("split here",
      "this visit and all later ones show another object", () => edits.split(o, [visit[0], end]))] : [])));
  const tracklets = o.tracklets.map(([number, ...span]) => spanRow(o, span,
    `${number}: ${span[0]}–${span[1]}`, ...(o.tracklets.length > 1 && o.refs.some(([, n]) => n === number)
      ? [splitButton("split off", "this tracklet alone shows another object",
        () => edits.splitTracklet(o, number))] : [])));
  return [el("h3", {}, `Visits (${o.visits.length}), frames`), ...rows, el("div", { id: "cut" }),
    el("details", {}, el("summary", {}, `tracklets (${o.tracklets.length})`), ...tracklets)];
}

function fillCut() {                             // a split inside the visit at the slider's position
  const o = state.selected, box = $("cut");
  if (!o || !box) return;
  const frame = frameOf(state.step);
  const visit = o.visits.find(([first, last]) => first < frame && frame <= last);
  box.replaceChildren(...(visit && o.refs.length ? [el("button", {
    title: `the object in frames ${frame} to ${visit[1]} is another one`,
    onclick: () => edit(edits.split(o, [frame, visit[1]])) }, `split at frame ${frame}`)] : [el("span",
    { className: "dim" }, "To split a visit, move the slider to the first frame of the other object.")]));
}
