// Manual corrections: a list, shown immediately, saved as edits.json (docs/scene.md).
const pending = [], takenBack = new Set();       // edits made here; numbers of earlier ones undone
let saved = true;

const refOf = (o) => {                           // an object is named by a box of its longest visit
  const [, , frame, ...box] = o.visits.reduce((a, b) => b[1] - b[0] > a[1] - a[0] ? b : a);
  return { id: o.id, frame, box };
};
const visitRef = ([, , frame, ...box]) => ({ frame, box });
const edits = {
  merge: (a, b) => ({ do: "merge", object: refOf(a), with: refOf(b) }),
  split: (o, visits) => ({ do: "split", object: refOf(o), visits: visits.map(visitRef) }),
  rename: (o, name) => ({ do: "rename", object: refOf(o), class: name }),
  delete: (o) => ({ do: "delete", object: refOf(o) }),
};

// ---- Objects after the edits; `objects OUT --edits` fits their solids again ----
function stepsOf(visits) {                       // first, last, first, last ... position seen
  const runs = [];
  S.steps.frame.forEach((frame, step) => {
    if (!visits.some(([first, last]) => first <= frame && frame <= last)) return;
    if (runs.at(-1) === step - 1) runs[runs.length - 1] = step; else runs.push(step, step);
  });
  return runs;
}
const within = (visits) => ([frame]) => visits.some(([a, b]) => a <= frame && frame <= b);
const hue = (id) => {                            // `object_color` in types.py
  const [s, v] = [(200 - 60 * (id % 2)) / 255, 255 - 45 * ((id >> 1) % 2)];
  return [5, 3, 1].map((n) => { const k = (n + 6 * (id * 0.381966 % 1)) % 6;
    return Math.round(v - v * s * Math.max(0, Math.min(k, 4 - k, 1))); });
};
const sure = (o) => o.status !== "doubtful" ? {} : { status: o.center ? "ok" : "tracked", reason: "" };
const NO_SOLID = { center: null, half_axes: null, size: null, size_m: null, sides: [],
  status: "tracked", reason: "its solid is fitted by objects OUT --edits" };

const APPLY = {
  merge(list, { object, with: other }) {
    const [kept, gone] = [object.id, other.id].sort((a, b) => a - b)
      .map((id) => list.find((o) => o.id === id));
    const large = kept.frames_seen >= gone.frames_seen ? kept : gone;
    const base = kept.center || !gone.center ? kept : gone;
    const visits = [...kept.visits, ...gone.visits].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    const made = { ...base, ...sure(base), id: kept.id, color: kept.color, class: large.class,
      visits, crops: [...kept.crops, ...gone.crops].sort((a, b) => a[0] - b[0]),
      frames_seen: kept.frames_seen + gone.frames_seen, seen: stepsOf(visits),
      tracks: [...kept.tracks, ...gone.tracks], ids: [...kept.ids, ...gone.ids], edited: true };
    return list.filter((o) => o !== gone).map((o) => o === kept ? made : o);
  },
  split(list, { object, visits }) {
    const o = list.find(({ id }) => id === object.id);
    const off = o.visits.filter(([, , frame, ...box]) => visits.some((v) => v.frame === frame
      && v.box.every((x, i) => x === box[i])));
    const rest = o.visits.filter((v) => !off.includes(v)), id = Math.max(...list.map((x) => x.id)) + 1;
    const part = (own) => ({ visits: own, seen: stepsOf(own), edited: true,
      crops: o.crops.filter(within(own)),
      frames_seen: Math.round(o.frames_seen * own.reduce((s, [a, b]) => s + b - a + 1, 0)
        / o.visits.reduce((s, [a, b]) => s + b - a + 1, 0)) });
    return [...list.map((x) => x === o ? { ...o, ...part(rest) } : x),
      { ...o, ...NO_SOLID, ...part(off), id, color: hue(id), ids: [] }];
  },
  rename: (list, { object, class: name }) => list.map((o) => o.id === object.id
    ? { ...o, ...sure(o), class: name, edited: true } : o),
  delete: (list, { object }) => list.filter((o) => o.id !== object.id),
};

function replay() {                              // from the objects of the page
  const chosen = state.selected?.id;
  objects = pending.reduce((list, edit) => APPLY[edit.do](list, edit),
    S.objects.map((o) => ({ ...o, ids: [o.id] })));
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
  hint(both ? `both are seen in ${both} frames at once: are they one object? (u: undo)` : "");
}
function undo() {
  if (!pending.pop()) return;
  saved = !pending.length && !takenBack.size;
  replay();
}

// ---- The list of edits, and the file ----
const said = (e) => ({
  merge: () => `merge ${e.object.id} with ${e.with.id}`,
  split: () => `split ${e.visits.length} visit${e.visits.length > 1 ? "s" : ""} off ${e.object.id}`,
  rename: () => `rename ${e.object.id} to ${e.class}`,
  delete: () => `delete ${e.object.id}`,
})[e.do]();

function fillEdits() {
  const bar = $("edits"), earlier = S.edits.map((e, i) => el("li",
    { className: takenBack.has(i) ? "undone" : "dim" }, `${said(e)} (applied) `,
    el("button", { title: "undo; visible after the next fit", onclick: () => {
      takenBack[takenBack.has(i) ? "delete" : "add"](i);
      saved = false;
      fillEdits();
    } }, takenBack.has(i) ? "keep" : "×")));
  bar.hidden = !pending.length && !S.edits.length;
  const changed = pending.length || takenBack.size;
  bar.replaceChildren(el("b", {}, "Corrections"),
    el("ol", {}, ...earlier, ...pending.map((e) => el("li", {}, said(e)))),
    el("button", { id: "undo", disabled: !pending.length, onclick: undo }, "Undo"),
    el("button", { id: "save", className: "main", disabled: !changed, onclick: save },
      "Save edits.json"));
}

const editsFile = () => JSON.stringify({ format: "reobj-edits", version: 1, map: S.map,
  edits: [...S.edits.filter((_, i) => !takenBack.has(i)), ...pending] }, null, 1) + "\n";

function save() {
  const url = URL.createObjectURL(new Blob([editsFile()], { type: "application/json" }));
  el("a", { href: url, download: "edits.json" }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
  saved = true;
  $("saved").replaceChildren(el("h2", {}, "edits.json"),
    el("p", {}, "The browser has put edits.json among your downloads. Apply it to the output "
      + "folder (here OUT), which makes objects, solids and this page again:"),
    el("p", {}, el("code", {}, "reobj-track objects OUT --edits edits.json")),
    el("p", { className: "dim" }, "OUT keeps the corrections: later fits apply them again."),
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
  const act = el("div", { className: "act" }), form = renameForm(o);
  form.hidden = true;
  act.append(
    el("button", { title: "it is the same as another object", onclick: () => {
      state.merging = o;
      hint(`click the object that is the same as ${o.class} ${o.id} (Esc: none)`);
    } }, "Merge with …"),
    el("button", { onclick: () => { form.hidden = false; form.querySelector("input").select(); } },
      "Rename …"),
    el("button", { title: "false positive (Delete)", onclick: () => edit(edits.delete(o)) },
      "Delete"));
  return [el("h3", {}, "Correct it"), act, form];
}

function visitRows(o) {
  const rows = o.visits.map((visit, i) => el("div", { className: "visit" },
    el("span", {}, `${visit[0]}–${visit[1]}`), el("span", {},
      el("button", { onclick: () => goTo(S.steps.frame.findLastIndex((f) => f <= visit[2])) }, "show"),
      ...(o.visits.length > 1 ? [" ", el("button",
        { title: "this visit alone shows another object", onclick: () => edit(edits.split(o, [visit])) },
        "split off")] : []),
      ...(i > 0 && i < o.visits.length - 1 ? [" ", el("button",
        { title: "this visit and all later ones show another object",
          onclick: () => edit(edits.split(o, o.visits.slice(i))) }, "split here")] : []))));
  return [el("h3", {}, `Visits (${o.visits.length}), frames`), ...rows];
}
