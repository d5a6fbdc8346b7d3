// Pictures behind the shapes, seen from the camera: of the recording where it is there, else those
// of the page. The view moves to a step when its picture is there.
const SERVED = JSON.parse($("served").textContent);   // what the server of `serve` offers, or null
const film = $("film");
let filmed = false, backdrop = null;             // {step, image, raw: not undistorted} of state.seat
const timeOf = (step) => S.steps.time[step];
const HALF_FRAME_S = 0.5 * S.steps.frame_s;

function startFilm() {                           // at the first ride: nothing is loaded before
  const source = SERVED ? SERVED.recording : encodeURIComponent(S.film);
  if (!source || film.src) return;
  film.onloadeddata = () => {                    // the right size: it may be another file of this name
    const ratio = film.videoWidth / film.videoHeight * S.size.height / S.size.width;
    filmed = Math.abs(ratio - 1) < 0.02;
    if (filmed && state.ride) goTo(state.step);
  };
  film.onerror = () => { if (SERVED) hint("this browser cannot play the recording: 60 pictures"); };
  film.onseeked = () => {
    const { sought, asked } = state;
    state.sought = null;
    if (playing === -1 || sought === null) return;  // the film goes on: `followFilm` has its frames
    if (asked !== sought) seek(asked); else arrive(sought, film);
  };
  film.onended = () => { if (playing) playFilm(steps[0]); };
  film.src = source;
}

// ---- The picture of a step ----
const exact = (step) => S.thumbs.find(([frame]) => frame === frameOf(step));
const everyFrame = () => filmed || Boolean(SERVED?.frames);
const pictured = () => steps.filter((step) => cams[step] && (everyFrame() || exact(step)));

function seek(step) {
  state.sought = step;
  film.currentTime = timeOf(step) + HALF_FRAME_S / 2;
}
function ask(step) {
  state.asked = step;
  if (filmed) { if (state.sought == null) seek(step); return; }
  const thumb = exact(step), source = SERVED?.frames ? `frame/${frameOf(step)}` : thumb && picture(thumb[1]);
  if (!source) { arrive(step, null); return; }
  const image = new Image();
  image.onload = () => { if (state.asked === step) arrive(step, image); };
  image.onerror = () => { if (state.asked === step) arrive(step, null); };
  image.src = source;
}
const still = document.createElement("canvas");  // a frame of the film, which goes on while it is drawn
function arrive(step, image) {
  if (image === film) {
    [still.width, still.height] = [film.videoWidth, film.videoHeight];
    still.getContext("2d").drawImage(film, 0, 0);
  }
  backdrop = { step, image: image === film ? still : image, raw: everyFrame() };
  state.seat = step;
  redraw();
}

// ---- Play: the recording leads, the shapes follow ----
function playFilm(step) {
  film.currentTime = timeOf(step) + HALF_FRAME_S / 2;
  film.play();
  film.requestVideoFrameCallback(followFilm);
}
function followFilm(_, { mediaTime }) {
  if (!playing || !state.ride) { film.pause(); return; }
  const step = steps.findLast((s) => timeOf(s) <= mediaTime + HALF_FRAME_S) ?? steps[0];
  if (mediaTime > timeOf(steps.at(-1)) + 2 * HALF_FRAME_S) { playFilm(steps[0]); return; }
  if (Math.abs(timeOf(step) - mediaTime) <= HALF_FRAME_S && cams[step]) goTo(step, film);
  film.requestVideoFrameCallback(followFilm);
}

// ---- Drawing: frames of the recording are undistorted cell by cell, as the shapes are ----
const LENS = S.camera?.lens ? floats(S.camera.lens.grid) : null;   // distorted place of each corner, 0 to 1
function paint(canvas, { image, raw }) {
  const pen = canvas.getContext("2d"), { width, height } = canvas;
  const [w, h] = [image.naturalWidth || image.width, image.naturalHeight || image.height];
  if (!LENS || !raw) { pen.drawImage(image, 0, 0, width, height); return; }
  const { columns, rows } = S.camera.lens;
  const corner = (i, j, k) => LENS[2 * (j * (columns + 1) + i) + k];
  pen.clearRect(0, 0, width, height);
  for (let j = 0; j < rows; j++) for (let i = 0; i < columns; i++) {
    const [left, right] = [i, i + 1].map((c) => (corner(c, j, 0) + corner(c, j + 1, 0)) / 2 * w);
    const [top, bottom] = [j, j + 1].map((r) => (corner(i, r, 1) + corner(i + 1, r, 1)) / 2 * h);
    const [x, x2] = [i, i + 1].map((c) => Math.round(c * width / columns));
    const [y, y2] = [j, j + 1].map((r) => Math.round(r * height / rows));
    if (right > left && bottom > top) pen.drawImage(image, left, top, right - left, bottom - top,
      x, y, x2 - x, y2 - y);
  }
}

function placePicture(inside) {
  const back = $("back");
  back.hidden = !inside || !backdrop?.image || backdrop.step !== state.seat;
  $("drawn").querySelectorAll(".box").forEach((box) => box.remove());
  if (!inside) return;
  const { scale, x, y } = pictureRect(), { width, height } = S.camera;
  if (!back.hidden) {
    const size = [width, height].map((side) => Math.round(side * scale * devicePixelRatio));
    const key = `${frameOf(state.seat)} ${size} ${backdrop.raw}`;
    if (back.dataset.key !== key) {
      [back.width, back.height] = size;
      paint(back, backdrop);
    }
    Object.assign(back.dataset, { key, frame: frameOf(state.seat) });
    Object.assign(back.style, { left: `${x}px`, top: `${y}px`, width: `${width * scale}px`,
      height: `${height * scale}px` });
  }
  if ($("boxes").checked) $("drawn").append(...boxesAt(state.seat).map((box) => {
    box.setAttribute("transform", `translate(${x} ${y}) scale(${scale})`); return box; }));
}

// ---- Boxes of a step: detections, and faint those that fill gaps ----
const BOXES = new Map(S.objects.map((o) => [o.id, floats(o.boxes)]));
const runAt = (runs, step) => runs.findIndex((first, i) => i % 2 === 0 && first <= step && step <= runs[i + 1]);
function boxOf(id, step) {                       // of an object of the page: x1, y1, x2, y2, filled
  const { seen, filled } = S.objects.find((o) => o.id === id), run = runAt(seen, step);
  if (run < 0) return null;
  const before = pairs(seen.slice(0, run)).reduce((sum, [a, b]) => sum + b - a + 1, 0);
  const at = 4 * (before + step - seen[run]);
  return [...BOXES.get(id).subarray(at, at + 4), runAt(filled, step) >= 0];
}
function boxesAt(step) {
  const found = objects.filter((o) => o.part === state.part && allowed(o) && seenAt(o, step))
    .flatMap((o) => o.sources.map((id) => [o, boxOf(id, step)]));
  return found.filter(([, box]) => box && box[0] === box[0]).map(([o, [x1, y1, x2, y2, filled]]) =>
    svg("rect", { class: filled ? "box filled" : "box", x: x1, y: y1, width: x2 - x1, height: y2 - y1,
      stroke: rgb(o) }));
}
