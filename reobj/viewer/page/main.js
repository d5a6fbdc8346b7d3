// Start: the selected component, buttons, keys, mouse and fingers.
const press = (id, on) => $(id).setAttribute("aria-pressed", String(Boolean(on)));
function hint(text) {
  $("hint").textContent = text;
  $("hint").hidden = !text;
}

function gather() {                              // the objects of the part
  here = state.session ? objectsThen(state.session) : objects.filter((o) => o.part === state.part);
  solid = here.filter((o) => o.center);
  gatherGhosts();
}

function enter(part) {                           // show one part of the cameras' path, a world
  if (here) select(null);
  if (state.ride) setRide(false);
  Object.assign(state, { part, step: -1, seat: -1, measured: [] });
  setFollow(false);
  level = levelFrame(part);
  $("session").hidden = !EARLIER.length || !inMap(part);
  if (state.session && !inMap(part)) enterSession(null);
  gather();
  steps = [...S.steps.part.keys()].filter((i) => S.steps.part[i] === part);
  cams = S.steps.frame.map((_, i) => S.steps.part[i] === part ? camera(i) : null);
  posed = cams.filter(Boolean);
  $("part").value = part;
  $("facts").textContent = S.parts[part].facts;
  $("grade").hidden = !S.parts[part].directions_only;
  $("slider").max = Math.max(steps.length - 1, 0);
  $("slider").value = 0;
  $("clock").textContent = "";
  $("frame").hidden = true;
  $("list").style.removeProperty("--now");
  $("unit-label").hidden = !level.metres;
  $("dense-label").hidden = !S.parts[part].dense;
  fillList();
  showOnly([], null);
  if (renderer) { fillScene(); VIEWS.reset(); }
}

// ---- Buttons ----
const KEYS = [
  ["Space", "play, stop", () => play()],
  ["ArrowLeft", "a step back", () => onward(-1)],
  ["ArrowRight", "a step on", () => onward(1)],
  ["r", "Reset: the whole scene", () => VIEWS.reset()],
  ["1", "Top: from above", () => VIEWS.top()],
  ["2", "Front: from the side", () => VIEWS.front()],
  ["f", "Follow the moving camera", () => setFollow(!state.follow)],
  ["a", "ride along: look through the camera", () => setRide(!state.ride)],
  ["m", "measure", () => setMeasure(!state.measuring)],
  ["Delete", "delete the selected object", () => state.selected && !state.session && edit(edits.delete(state.selected))],
  ["u", "undo a correction", undo],
  ["Escape", "end merging, measuring, riding; deselect", leave],
  ["?", "this help", () => $("help").open ? $("help").close() : $("help").showModal()],
];
const IN_2D = ["Space", "ArrowLeft", "ArrowRight", "Delete", "u", "Escape", "?"];

function leave() {                               // the innermost mode
  if (state.merging) { state.merging = null; hint(""); }
  else if (state.measuring) setMeasure(false);
  else if (state.ride) setRide(false);
  else if (state.follow) setFollow(false);
  else if (state.selected) select(state.selected);
  else if (state.ghost) select(null);
}

addEventListener("keydown", (e) => {
  if (e.ctrlKey || e.metaKey || e.altKey) {
    if (e.key === "z" && !e.target.matches("input[type=text], input[type=search]")) undo();
    return;
  }
  if (e.target.matches("input[type=text], input[type=search], select")) return;
  if (e.target.matches("#slider") && e.key.startsWith("Arrow")) return;
  if (e.target.matches("button, summary, input[type=checkbox]") && e.key === " ") return;
  if (document.querySelector("dialog[open]") && e.key !== "?") return;
  const name = e.key === " " ? "Space" : e.key.length === 1 ? e.key.toLowerCase() : e.key;
  const key = KEYS.find(([own]) => own === name);
  if (!key || !renderer && !IN_2D.includes(name)) return;
  e.preventDefault();
  key[2]();
});

for (const id of ["reset", "top", "front"]) $(id).onclick = VIEWS[id];
$("follow").onclick = () => setFollow(!state.follow);
$("ride").onclick = () => setRide(!state.ride);
$("measure").onclick = () => setMeasure(!state.measuring);
$("help-button").onclick = () => $("help").showModal();
$("play").onclick = play;
$("slider").oninput = () => goTo(steps[+$("slider").value]);
$("part").onchange = () => enter(+$("part").value);
$("search").oninput = () => { filterList(); redraw(); };
$("sort").onchange = fillList;
$("unit").onchange = () => {
  state.unit = $("unit").value;
  fillList();
  const o = state.selected;
  if (o) { select(o); select(o); }
  redraw();
};
for (const id of ["solids", "ellipsoids", "names", "points", "dense", "cameras", "grid", "boxes"]) {
  $(id).onchange = redraw;
}
$("doubtful").onchange = () => {
  if (state.selected?.status === "doubtful") select(state.selected);
  filterList();
  redraw();
};
const rowsOf = (rows) => el("dl", {}, ...rows.flatMap(([name, text]) =>
  [el("dt", {}, name), el("dd", {}, text)]));
const FINGERS = [el("h2", {}, "Fingers"), rowsOf([["drag", "rotate"], ["two fingers", "move"],
  ["spread, pinch", "zoom"], ["tap an object", "select, deselect"], ["tap twice", "rotate around the object"],
  ["Measure", "then tap two points"], ["video frame", "drag to move, + enlarges, × closes"]])];
const MOUSE = [el("h2", {}, "Mouse"), rowsOf([["drag", "rotate"], ["right button, shift", "move"],
  ["wheel", "zoom"], ["click an object", "select, deselect"], ["double click", "rotate around the object"]]),
  el("h2", {}, "Keys"), rowsOf(KEYS.map(([key, text]) => [el("kbd", {},
    { ArrowLeft: "←", ArrowRight: "→", Escape: "Esc" }[key] || key), text]))];
const touch = matchMedia("(pointer: coarse)").matches;
$("help").append(...(touch ? [...FINGERS, ...MOUSE] : [...MOUSE, ...FINGERS]),
  el("p", { className: "dim" }, "Sizes are width × depth × height, along the object's own axes "
    + "(height is the upright one), rounded as their standard deviation allows."),
  el("div", { className: "act" }, el("button", { className: "main",
    onclick: () => $("help").close() }, "Close")));

// ---- A click: press and release at the same position ----
let pressed = null, clicked = [];                // objects under the last two clicks
canvas.addEventListener("pointerdown", (e) => {
  $("show").open = false;
  pressed = pressed || !e.isPrimary ? null : { x: e.clientX, y: e.clientY };
});
canvas.addEventListener("pointermove", (e) => {
  if (pressed && Math.hypot(e.clientX - pressed.x, e.clientY - pressed.y) > 6) pressed = null;
});
canvas.addEventListener("pointerup", (e) => {
  if (!pressed || e.button !== 0) { pressed = null; return; }
  pressed = null;
  const { left, top } = canvas.getBoundingClientRect(), at = [e.clientX - left, e.clientY - top];
  clicked = [clicked[1], pick(...at)];
  if (state.measuring) measureAt(...at); else choose(...at);
});
canvas.addEventListener("dblclick", () => {      // the panel, opened by the first click, moves the view
  const [o] = clicked;
  if (!o || state.measuring || state.merging) return;
  if (o !== state.selected) select(o);
  lookAt(o);
});
addEventListener("resize", () => { placeInset(); redraw(); });
dark.addEventListener("change", () => {
  if (!renderer) return;
  fillScene();
  redraw();
});

// ---- Start ----
document.title = $("title").textContent = `${S.title}: ${foundText(S.objects)}`
  + (S.parts.length > 1 ? ` in ${S.parts.length} components` : "");
$("part").append(...S.parts.map(({ name }, value) => el("option", { value }, name)));
$("part").hidden = S.parts.length < 2;
startChanges();
startSessions();
$("doubtful").checked = S.doubtful;
$("points").checked = !S.parts.some((part) => part.dense);   // the same surfaces
$("doubtful-label").hidden = !S.objects.some((o) => o.status === "doubtful");
objects = S.objects.map((o) => ({ ...o, ids: [o.id], sources: [o.id] }));
if (S.why_flat || !prepare()) {
  document.body.classList.add("flat");
  $("view").prepend(el("p", { id: "why" }, `No 3D view: ${S.why_flat || "no WebGL here"}. Below: `
    + "when each object is seen; click one for its pictures."));
}
for (const id of ["follow", "ride", "measure"]) press(id, false);
markPlay(false);
enlarge(false);
enter(0);
openFragment();
if (job.running) watchJob(); else fillEdits();
