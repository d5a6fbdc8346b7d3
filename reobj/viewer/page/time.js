// Time: the slider, play, the frames of the video, Follow and Ride along.
const frameOf = (step) => S.steps.frame[step];

function pictureAt(step) {                       // [frame, picture, boxes]: the last one until then
  const first = frameOf(steps[0]);
  return S.thumbs.findLast(([frame]) => first <= frame && frame <= frameOf(step));
}

function goTo(step, image = null) {              // image: of the step, where it is here already
  if (S.steps.part[step] !== state.part) enter(S.steps.part[step]);
  if (state.ride && pictured().length) {         // only frames with a picture show whether it fits
    const gap = (s) => Math.abs(s - step);
    step = pictured().reduce((a, b) => gap(b) < gap(a) ? b : a);
  }
  const before = cams[state.step], after = cams[step];
  state.step = step;
  $("slider").value = steps.indexOf(step);
  const thumb = pictureAt(step), [first, last] = [steps[0], steps.at(-1)].map(frameOf);
  $("clock").textContent = `frame ${frameOf(step)}`
    + (after || S.why_flat ? "" : " (no pose)");
  $("frame").hidden = !thumb;
  if (thumb) {
    $("frame").querySelector("img").src = picture(thumb[1]);
    const drawing = $("frame").querySelector("svg");
    const size = S.camera || S.size;
    drawing.setAttribute("viewBox", `0 0 ${size.width} ${size.height}`);
    drawing.replaceChildren(...boxesAt(S.steps.frame.indexOf(thumb[0])).map((box) => {
      box.style.strokeDasharray = "none"; return box; }));
  }
  $("list").style.setProperty("--now", `${100 * (frameOf(step) - first) / (last - first + 1)}%`);
  here.forEach((o) => o.row.classList.toggle("now", seenAt(o, step)));
  fillCut();
  if (image) arrive(step, image);
  else if (state.ride) ask(step);
  else state.seat = step;
  if (state.follow && after && !state.ride) followTo(before, after);
  redraw();
}

// ---- Play ----
let playing = null;
const PLAY = "M2 1l9 5-9 5z", PAUSE = "M2 1h3v10h-3zM7 1h3v10h-3z";
function markPlay(on) {                          // drawn: fonts lack the sign of pause
  $("play").querySelector("path").setAttribute("d", on ? PAUSE : PLAY);
  $("play").setAttribute("aria-label", on ? "pause" : "play");
}
function onward(by = 1) {
  const list = state.ride && pictured().length ? pictured() : steps;
  const at = list.findLastIndex((step) => step <= state.step);
  goTo(list[(at + by + list.length) % list.length]);
}
function play() {
  markPlay(!playing);
  if (playing) { playing = clearInterval(playing); film.pause(); return; }
  if (state.ride && filmed && film.requestVideoFrameCallback) {
    playing = -1;                                // no timer
    playFilm(Math.max(state.step, steps[0]));
    return;
  }
  const stride = state.ride ? Math.max(1, steps.length / Math.max(pictured().length, 1)) : 1;
  playing = setInterval(onward, S.steps.seconds * 1000 * stride);
}

// ---- Follow: the moving camera stays in view, and one turns with it ----
const yawOf = (cam) => Math.atan2(cam.forward[1], cam.forward[0]);
function followTo(before, after) {
  const offset = orbit.position.clone().sub(controls.target);
  if (before) offset.applyAxisAngle(orbit.up, yawOf(after) - yawOf(before));
  controls.target.set(...add(after.at, after.forward, room.radius / 4));
  orbit.position.copy(controls.target).add(offset);
  controls.update();
}
function setFollow(on) {
  state.follow = on;
  press("follow", on);
  if (!on) return;
  setRide(false);
  if (state.step < 0 || !cams[state.step]) goTo(steps.find((step) => cams[step]) ?? steps[0]);
  const cam = cams[state.step];
  if (!cam) return;
  const back = unit([-cam.forward[0], -cam.forward[1], 0.55]);
  controls.target.set(...add(cam.at, cam.forward, room.radius / 4));
  orbit.position.copy(controls.target).add(V.set(...times(back, 0.9 * room.radius)));
  controls.update();
}

// ---- Ride along: the video frame behind the solids, seen from its own camera ----
function setRide(on) {
  if (Boolean(state.ride) === on) return;
  state.ride = on;
  press("ride", on);
  if (on) setFollow(false);
  if (on) startFilm();
  if (playing) { play(); play(); }               // at the pace of the pictures
  document.body.classList.toggle("riding", on);
  if (on) goTo(Math.max(state.step, steps[0]));
  redraw();
}

// ---- The video frame above the 3D view: dragged, enlarged, closed ----
const inset = { right: 8, bottom: 8, from: null };
function placeInset() {                          // inside the view
  const frame = $("frame"), view = $("view");
  const within = (x, room) => Math.max(0, Math.min(x, room));
  inset.right = within(inset.right, view.clientWidth - frame.offsetWidth);
  inset.bottom = within(inset.bottom, view.clientHeight - frame.offsetHeight);
  frame.style.right = `${inset.right}px`;
  frame.style.bottom = `${inset.bottom}px`;
}
function enlarge(on) {
  $("frame").classList.toggle("large", on);
  $("frame-size").textContent = on ? "−" : "+";
  placeInset();
}
$("frame").onpointerdown = (e) => {
  if (e.target.closest("button") || document.body.classList.contains("flat")) return;
  $("frame").setPointerCapture(e.pointerId);
  inset.from = { x: e.clientX + inset.right, y: e.clientY + inset.bottom };
};
$("frame").onpointermove = (e) => {
  if (!inset.from) return;
  inset.right = inset.from.x - e.clientX;
  inset.bottom = inset.from.y - e.clientY;
  placeInset();
};
$("frame").onpointerup = $("frame").onpointercancel = () => { inset.from = null; };
$("frame-size").onclick = () => enlarge(!$("frame").classList.contains("large"));
$("frame-close").onclick = () => $("inset").click();
$("inset").onchange = () => $("frame").classList.toggle("closed", !$("inset").checked);
