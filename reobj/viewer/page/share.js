// The view as a picture, and as a link: "#" and part, camera, object, step of the slider.
function fragmentOf() {
  const numbers = (v) => v.toArray().map((x) => +x.toFixed(4)).join(",");
  const facts = { part: state.part, eye: numbers(orbit.position), target: numbers(controls.target) };
  if (state.selected) facts.object = state.selected.id;
  if (state.step >= 0) facts.frame = frameOf(state.step);
  return `#${new URLSearchParams(facts)}`;
}

function openFragment() {                        // false: there is none, or not one of ours
  const facts = new URLSearchParams(location.hash.slice(1)), part = +facts.get("part");
  const place = (key) => (facts.get(key) || "").split(",").map(Number);
  const [eye, target] = ["eye", "target"].map(place), step = S.steps.frame.indexOf(+facts.get("frame"));
  if (!renderer || !facts.has("eye") || !S.parts[part]
    || [eye, target].some((v) => v.length !== 3 || !v.every(Number.isFinite))) return false;
  if (part !== state.part) enter(part);
  if (facts.has("frame") && S.steps.part[step] === part) goTo(step);
  const o = here.find(({ id }) => id === +facts.get("object"));
  if (o && facts.has("object") && o !== state.selected) select(o);
  setRide(false);
  orbit.position.set(...eye);
  controls.target.set(...target);
  controls.update();
  return true;
}

function copyLink() {
  history.replaceState(null, "", fragmentOf());
  const shown = () => hint("the address of this page now leads to this view");
  if (!navigator.clipboard) { shown(); return; }
  navigator.clipboard.writeText(location.href).then(() => hint("the link to this view is copied"), shown);
}

// ---- PNG of the 3D view: shapes, points, labels, scale bar, measured distance ----
function pictureOf() {                           // a canvas
  draw();                                        // its pixels are lost after this task
  const made = el("canvas", { width: canvas.width, height: canvas.height }), pen = made.getContext("2d");
  const box = $("view").getBoundingClientRect(), back = $("back");
  const at = (node) => { const r = node.getBoundingClientRect();
    return [r.left - box.left, r.top - box.top, r.width, r.height]; };
  pen.fillStyle = css("--paper");
  pen.fillRect(0, 0, made.width, made.height);
  pen.scale(devicePixelRatio, devicePixelRatio);
  if (!back.hidden) pen.drawImage(back, ...at(back));
  pen.drawImage(canvas, 0, 0, box.width, box.height);
  Object.assign(pen, { textAlign: "center", textBaseline: "middle", font: "12px system-ui, sans-serif" });
  const write = (node, paper) => {
    const [x, y, w, h] = at(node), style = getComputedStyle(node);
    if (paper) { pen.fillStyle = style.backgroundColor; pen.fillRect(x, y, w, h); }
    pen.fillStyle = paper ? style.color : css("--ink");
    pen.fillText(node.textContent, x + w / 2, y + h / 2);
  };
  [...$("labels").children].forEach((label) => write(label, true));
  for (const line of $("drawn").querySelectorAll(".measure line")) {
    pen.strokeStyle = css("--mark");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(line.getAttribute("x1"), line.getAttribute("y1"));
    pen.lineTo(line.getAttribute("x2"), line.getAttribute("y2"));
    pen.stroke();
  }
  $("drawn").querySelectorAll(".measure text").forEach((text) => write(text, false));
  if (riding()) return made;
  write($("bar").querySelector("span"), false);
  const [x, y, w] = at($("bar").querySelector("i"));
  pen.fillStyle = css("--ink");
  pen.fillRect(x, y, w, 2);
  return made;
}

function savePicture() {
  pictureOf().toBlob((blob) => {
    const url = URL.createObjectURL(blob), name = S.title.replace(/[^\p{L}\p{N}.-]+/gu, "_");
    el("a", { href: url, download: `${name}.png` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10000);
  });
}

$("save-picture").onclick = savePicture;
$("copy-link").onclick = copyLink;
addEventListener("hashchange", openFragment);
