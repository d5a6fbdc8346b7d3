// The 3D view: three.js draws solids, points, cameras and the floor; text is HTML above it.
const canvas = $("canvas"), V = new THREE.Vector3();
let renderer = null, gl = null;
const scene = new THREE.Scene(), root = new THREE.Group();
scene.add(root);
const orbit = new THREE.PerspectiveCamera(50, 1, 0.01, 1000), seat = new THREE.PerspectiveCamera();
seat.matrixAutoUpdate = false;
orbit.up.set(0, 0, 1);
let controls, room, cloud, dense, wires, former, travel, now, floorGrid;
const dark = matchMedia("(prefers-color-scheme: dark)");
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function prepare() {                             // false where there is no WebGL
  if (!el("canvas").getContext("webgl2")) return false;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, alpha: true, antialias: true });
  } catch { return false; }
  gl = renderer.getContext();
  controls = new THREE.OrbitControls(orbit, canvas);
  controls.zoomToCursor = true;
  controls.addEventListener("change", redraw);
  controls.addEventListener("start", () => { if (state.ride) setRide(false); });
  return true;
}

// ---- Objects and points ----
const BOX = [[-1, -1], [1, -1], [1, 1], [-1, 1]];
const ring = (n, f) => [...Array(n).keys()].flatMap((i) =>
  [i, i + 1].map((k) => f(Math.cos(2 * Math.PI * k / n), Math.sin(2 * Math.PI * k / n)))).flat();
const EDGES = {                                  // of the unit solids: pairs of ends
  box: BOX.flatMap(([x, y], i) => { const [u, v] = BOX[(i + 1) % 4];
    return [x, y, -1, u, v, -1, x, y, 1, u, v, 1, x, y, -1, x, y, 1]; }),
  cylinder: [...ring(40, (c, s) => [c, s, -1]), ...ring(40, (c, s) => [c, s, 1]),
    ...BOX.flatMap(([x, y]) => [x, y, -1, x, y, 1].map((v, i) => i % 3 < 2 ? v * Math.SQRT1_2 : v))],
  ellipsoid: [...ring(40, (c, s) => [c, s, 0]), ...ring(40, (c, s) => [c, 0, s]),
    ...ring(40, (c, s) => [0, c, s])],
};
const tin = new THREE.CylinderGeometry(1, 1, 2, 32).rotateX(Math.PI / 2);
const FACES = { box: new THREE.BoxGeometry(2, 2, 2), cylinder: tin,
  ellipsoid: new THREE.SphereGeometry(1, 32, 16) };
const WIRES = Object.fromEntries(Object.entries(EDGES).map(([kind, ends]) =>
  [kind, new THREE.LineSegmentsGeometry().setPositions(ends)]));

const colored = (o) => new THREE.Color().setRGB(...times(o.color, 1 / 255), "srgb");
const lineOf = (color, linewidth, more = {}) => new THREE.LineMaterial(
  { color, linewidth, transparent: true, depthWrite: false, ...more });

function lines(ends, color, width, opacity = 1) {
  const made = new THREE.LineSegments2(new THREE.LineSegmentsGeometry().setPositions(ends),
    lineOf(color, width, { opacity }));
  made.frustumCulled = false;
  return made;
}

function solidOf(o) {                            // group of an object: faces, ellipsoid, wire, halo
  const group = new THREE.Group(), color = colored(o);
  const axes = axesOf(o.quat_wxyz).map(level.turn);
  const scaled = axes.map((axis, i) => times(axis, o.half_axes[i] * level.size));
  o.at = level.place(o.center);
  o.axes = scaled;
  group.matrixAutoUpdate = false;
  group.matrix.set(...[0, 1, 2].flatMap((i) => [...scaled.map((axis) => axis[i]), o.at[i]]),
    0, 0, 0, 1);
  const pale = (opacity) => new THREE.MeshBasicMaterial(
    { color, transparent: true, opacity, depthWrite: false, side: THREE.DoubleSide });
  const wire = WIRES[o.support], doubt = !counted(o) || o.kind, ink = color.clone();
  if (!dark.matches && !o.kind) ink.multiplyScalar(0.6);    // pale lines would be lost on white
  group.parts = {
    faces: new THREE.Mesh(FACES[o.support], pale(0.06)),
    ellipsoid: new THREE.Mesh(FACES.ellipsoid, pale(0.16)),
    halo: new THREE.LineSegments2(wire, lineOf(css("--halo"), 6)),
    wire: new THREE.LineSegments2(wire, lineOf(ink, 1.8,
      doubt ? { dashed: true, dashSize: 0.12, gapSize: 0.1 } : {})),
  };
  if (doubt) group.parts.wire.computeLineDistances();
  group.parts.faces.object = o;
  group.parts.wire.renderOrder = 2;
  group.parts.halo.renderOrder = 1;
  group.add(...Object.values(group.parts));
  o.group = group;
  return group;
}

function frustum(cam, size) {                    // ends of the lines of a camera, as long as `size`
  const { width, height, fx, fy, cx, cy } = S.camera;
  const center = add(cam.at, cam.forward, size);
  const corner = [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) =>
    add(add(center, cam.right, size * (u - cx) / fx), cam.down, size * (v - cy) / fy));
  return corner.flatMap((c, i) => [...cam.at, ...c, ...c, ...corner[(i + 1) % 4]]);
}

function cloudOf({ at, color }) {                // round points, about 2.5 pixels of the screen
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(at, 3));
  geometry.setAttribute("tint", new THREE.BufferAttribute(color, 3, true));
  const material = new THREE.ShaderMaterial({
    uniforms: { size: { value: 2.4 }, reach: { value: 1 }, pixels: { value: 1 } },
    vertexShader: `attribute vec3 tint; uniform float size, reach, pixels; varying vec3 shade;
      void main() { shade = tint; gl_Position = projectionMatrix * modelViewMatrix
        * vec4(position, 1.);
        gl_PointSize = pixels * clamp(size * reach / gl_Position.w, .7 * size, 1.9 * size); }`,
    fragmentShader: `varying vec3 shade; void main() {
      if (length(gl_PointCoord - .5) > .5) discard; gl_FragColor = vec4(shade, 1.); }`,
  });
  const made = new THREE.Points(geometry, material);
  made.frustumCulled = false;
  return made;
}

function denseOf({ count, low, step, voxel, data }) {   // points that are hidden from behind
  const geometry = new THREE.BufferGeometry(), all = bytes(data);
  const column = (Type, from, normalized) => new THREE.BufferAttribute(
    new Type(all.buffer, from, 3 * count), 3, normalized);
  geometry.setAttribute("position", column(Uint16Array, 0, false));
  geometry.setAttribute("tint", column(Uint8Array, 6 * count, true));
  geometry.setAttribute("seen", column(Int8Array, 9 * count, true));
  const material = new THREE.ShaderMaterial({
    uniforms: { size: { value: 1.5 * voxel * level.size }, focal: { value: 1 }, pixels: { value: 1 } },
    vertexShader: `attribute vec3 tint, seen; uniform float size, focal, pixels; varying vec3 shade;
      void main() { shade = tint; vec4 at = modelMatrix * vec4(position, 1.);
        vec3 from = mat3(modelMatrix) * seen;
        gl_Position = dot(from, cameraPosition - at.xyz) < 0. ? vec4(2., 2., 2., 1.)
          : projectionMatrix * viewMatrix * at;
        gl_PointSize = pixels * clamp(size * focal / gl_Position.w, 1.2, 14.); }`,
    fragmentShader: `varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.); }`,
  });
  const made = new THREE.Points(geometry, material), size = step * level.size;
  const at = level.place(low);
  made.matrixAutoUpdate = made.frustumCulled = false;
  made.matrix.set(...[0, 1, 2].flatMap((i) => [...times(level.rows[i], size), at[i]]), 0, 0, 0, 1);
  return made;
}

const nice = (x) => { const p = 10 ** Math.floor(Math.log10(x)); return x / p < 2 ? p
  : x / p < 5 ? 2 * p : 5 * p; };

function gridOf() {                              // on the floor, or under everything where unknown
  const { low, high } = room, span = Math.max(high[0] - low[0], high[1] - low[1]);
  const step = level.metres && span < 30 && span > 3 ? 0.5 : nice(span / 10), thin = [], bold = [];
  const from = [0, 1].map((i) => Math.floor((low[i] - 0.05 * span) / step));
  const to = [0, 1].map((i) => Math.ceil((high[i] + 0.05 * span) / step));
  const bottoms = solid.filter(counted).map((o) => level.place(o.center)[2]
    - level.size * Math.hypot(...axesOf(o.quat_wxyz).map((a, i) => level.turn(a)[2] * o.half_axes[i])));
  const z = level.floor ? 0 : Math.min(low[2], bottoms.length ? quantile(bottoms, 0.1) : low[2]);
  for (let i = from[0]; i <= to[0]; i++) (i % 2 ? thin : bold).push(
    i * step, from[1] * step, z, i * step, to[1] * step, z);
  for (let j = from[1]; j <= to[1]; j++) (j % 2 ? thin : bold).push(
    from[0] * step, j * step, z, to[0] * step, j * step, z);
  const group = new THREE.Group(), color = css("--grid");
  group.add(lines(thin.length ? thin : bold, color, 0.8, 0.35), lines(bold, color, 1, 0.6));
  return group;
}

function extent(points) {                        // box without outliers: of points and the path
  const axes = [0, 1, 2].map((i) => {
    const own = [], stride = 3 * Math.ceil(points.length / 15000);
    for (let k = i; k < points.length; k += stride) own.push(points[k]);
    const anchors = own.length > 100 ? own : solid.filter(counted)
      .map((o) => level.place(o.center)[i]);
    const path = posed.map((c) => c.at[i]), ends = anchors.length
      ? [quantile(anchors, 0.05), quantile(anchors, 0.95)] : [];
    return [Math.min(...ends, ...path), Math.max(...ends, ...path)];
  });
  const [low, high] = [0, 1].map((k) => axes.map((a) => Number.isFinite(a[k]) ? a[k] : k));
  if (level.floor) low[2] = Math.min(low[2], 0);
  const inside = (a) => a.every((x, i) => low[i] <= x && x <= high[i]), anchors = [];
  for (let k = 0; k < points.length; k += 3 * Math.ceil(points.length / 3000)) {
    anchors.push([...points.subarray(k, k + 3)]);
  }
  anchors.push(...posed.map((c) => c.at), ...solid.filter(counted).map((o) => level.place(o.center)));
  const kept = anchors.filter(inside);
  return { low, high, middle: times(add(low, high), 0.5), anchors: kept.length ? kept : [low, high],
    radius: Math.hypot(...add(high, low, -1)) / 2 || 1 };
}

function clear(group) {
  group.traverse((node) => { if (!Object.values(WIRES).includes(node.geometry)
    && !Object.values(FACES).includes(node.geometry)) node.geometry?.dispose();
    node.material?.dispose(); });
  group.clear();
}

function fillSolids() {                          // the objects as the edits have them
  clear(wires);
  solid.forEach((o) => wires.add(solidOf(o)));
  fillGhosts();
}

function fillScene() {                           // everything of the part
  clear(root);
  const points = pointsOf(state.part);
  room = extent(points.at);
  room.walls = alongWalls(points.at);
  cloud = cloudOf(points);
  [wires, former, travel, now] = [1, 2, 3, 4].map(() => new THREE.Group());
  floorGrid = gridOf();
  root.add(floorGrid, cloud, travel, now, wires, former);
  dense = S.parts[state.part].dense ? denseOf(S.parts[state.part].dense) : null;
  if (dense) root.add(dense);
  const ends = [], color = css("--path");
  cams.forEach((c, i) => { if (c && cams[i + 1]) ends.push(...c.at, ...cams[i + 1].at); });
  if (ends.length) travel.add(lines(ends, color, 2, 0.9));
  const views = some(posed, 24).flatMap((c) => frustum(c, room.radius / 28));
  if (views.length) travel.add(lines(views, color, 1, 0.55));
  fillSolids();
}

// ---- Viewpoint ----
function heading() {                             // level direction in which the cameras look most
  const sum = posed.reduce((s, c) => add(s, c.forward), [0, 0, 0]);
  const flat = [sum[0], sum[1], 0];
  if (Math.hypot(...flat) > 0.2 * posed.length) return unit(flat);
  return room.high[0] - room.low[0] > room.high[1] - room.low[1] ? [0, 1, 0] : [1, 0, 0];
}

function alongWalls(points) {                    // level direction of the walls: the yaw at which the
  const at = [];                                 // points lie in the fewest bins along both axes (entropy)
  for (let k = 0; k < points.length; k += 3 * Math.ceil(points.length / 12000)) at.push(points.subarray(k, k + 2));
  if (at.length < 100) return null;
  const width = room.radius / 40, entropy = (c, s) => {
    const bins = new Map();
    for (const [x, y] of at) { const bin = Math.round((c * x + s * y) / width);
      bins.set(bin, (bins.get(bin) || 0) + 1); }
    return [...bins.values()].reduce((sum, n) => sum - n * Math.log(n), 0);
  };
  const yaws = [...Array(90).keys()].map((deg) => { const c = Math.cos(deg * Math.PI / 180), s = Math.sin(deg * Math.PI / 180);
    return [entropy(c, s) + entropy(-s, c), [c, s, 0]]; });
  const [, axis] = yaws.reduce((a, b) => b[0] < a[0] ? b : a), h = heading();
  const turned = [axis, [-axis[1], axis[0], 0]].flatMap((v) => [v, times(v, -1)]);
  return turned.reduce((a, b) => dot(b, h) > dot(a, h) ? b : a);   // as the cameras look
}

function lookFrom(back) {                        // frame path, points and solids below the buttons
  const height = Math.max(canvas.clientHeight, 1);
  const aspect = canvas.clientWidth / height;
  const hidden = Math.min($("tools").offsetTop + $("tools").offsetHeight, height / 2) / height;
  const tan = Math.tan(orbit.fov / 360 * Math.PI), side = unit(cross([0, 0, 1], back));
  const top = cross(back, side);
  let target = room.middle, distance = 2.5 * room.radius;
  for (let turn = 0; turn < 16; turn++) {         // until the picture is centred and filled
    const seen = room.anchors.map((a) => { const off = add(a, target, -1);
      const depth = Math.max(distance - dot(off, back), 0.05 * distance) * tan;
      return [dot(off, side) / depth / aspect, dot(off, top) / depth]; });
    const [x, y] = [0, 1].map((i) => [0, 1].map((k) => quantile(seen.map((s) => s[i]), k)));
    target = add(add(target, side, (x[0] + x[1]) / 2 * distance * tan * aspect),
      top, ((y[0] + y[1]) / 2 + hidden) * distance * tan);
    distance *= Math.sqrt(Math.max(x[1] - x[0], (y[1] - y[0]) / (1 - hidden)) / 2 / 0.9);
  }
  setRide(false);
  controls.target.set(...target);
  orbit.position.set(...add(target, back, distance));
  controls.update();
  redraw();
}

const fromAbove = (deg, h = heading()) => { const a = deg * Math.PI / 180;
  return [-h[0] * Math.cos(a), -h[1] * Math.cos(a), Math.sin(a)]; };
const VIEWS = { reset: () => lookFrom(fromAbove(38)), top: () => lookFrom(fromAbove(89.9, room.walls || heading())),
  front: () => lookFrom(fromAbove(3)) };

function lookAt(o) {                             // turn about an object, from where one is
  if (!o?.at) return;
  const shift = add(o.at, controls.target.toArray(), -1);
  controls.target.set(...o.at);
  orbit.position.add(V.set(...shift));
  controls.update();
}

function pictureRect() {                         // where the video frame lies in the view, ridden
  const { width, height } = S.camera, [w, h] = [canvas.clientWidth, canvas.clientHeight];
  const scale = Math.min(w / width, h / height);
  return { scale, x: (w - width * scale) / 2, y: (h - height * scale) / 2 };
}

function sit(cam) {                              // the seat sees what the camera of the frame saw
  const { scale, x, y } = pictureRect(), { fx, fy, cx, cy } = S.camera;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight], near = room.radius / 200;
  const far = near * 1e4;
  seat.projectionMatrix.set(
    2 * fx * scale / w, 0, 1 - 2 * (cx * scale + x) / w, 0,
    0, 2 * fy * scale / h, 2 * (cy * scale + y) / h - 1, 0,
    0, 0, (far + near) / (near - far), 2 * far * near / (near - far), 0, 0, -1, 0);
  seat.projectionMatrixInverse.copy(seat.projectionMatrix).invert();
  const columns = [cam.right, times(cam.down, -1), times(cam.forward, -1), cam.at];
  seat.matrix.set(...[0, 1, 2].flatMap((i) => columns.map((c) => c[i])), 0, 0, 0, 1);
  seat.updateMatrixWorld(true);
}

const riding = () => Boolean(state.ride && cams[state.seat]);
function viewpoint() {
  if (riding()) { sit(cams[state.seat]); return seat; }
  const reach = orbit.position.distanceTo(controls.target);
  orbit.aspect = canvas.clientWidth / Math.max(canvas.clientHeight, 1);
  orbit.near = reach / 100;
  orbit.far = reach + 40 * room.radius;
  orbit.updateProjectionMatrix();
  orbit.updateMatrixWorld();
  return orbit;
}

function project(at, cam = viewpoint()) {        // pixels in the view and depth, or null
  V.set(...at).applyMatrix4(cam.matrixWorldInverse);
  const depth = -V.z;
  if (depth <= 0) return null;
  V.applyMatrix4(cam.projectionMatrix);
  return [(V.x + 1) / 2 * canvas.clientWidth, (1 - V.y) / 2 * canvas.clientHeight, depth];
}

// ---- Each picture ----
let waiting = false;
function redraw() {
  if (!renderer || waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; draw(); });
}

const FAINT = 0.15;                              // of objects that do not match the search
const isFound = (o) => o.found !== false;

function draw() {
  const [w, h] = [$("view").clientWidth, $("view").clientHeight];
  renderer.setPixelRatio(devicePixelRatio);
  renderer.setSize(w, h, false);
  const cam = viewpoint(), inside = cam === seat, visible = new Set(shown());
  for (const o of solid) {
    const { wire, halo, faces, ellipsoid } = o.group.parts, chosen = o === state.selected;
    const lit = chosen || state.step < 0 || o.then || seenAt(o, state.step);
    const strength = isFound(o) || chosen ? 1 : FAINT;
    o.group.visible = visible.has(o);
    const filled = chosen || o.status !== "implausible";   // of 20 m it would cover the room
    wire.visible = $("solids").checked;
    faces.visible = filled && $("solids").checked;
    ellipsoid.visible = filled && $("ellipsoids").checked || !$("solids").checked;
    halo.visible = chosen || Boolean(markOf(o)) && isFound(o);
    halo.material.color.set(css(chosen ? "--halo" : `--${changeOf(o)?.kind}`) || "#000");
    halo.material.opacity = chosen ? 1 : 0.6;
    wire.material.opacity = (lit ? 1 : 0.35) * strength;
    wire.material.linewidth = chosen ? 2.4 : inside ? 2.4 : 1.8;
    faces.material.opacity = (lit && !inside ? 0.06 : 0.02) * strength;
    ellipsoid.material.opacity = (lit ? 0.16 : 0.05) * (inside ? 0.6 : 1) * strength;
  }
  drawGhosts(inside);
  cloud.visible = $("points").checked && !inside;
  if (dense) {
    dense.visible = $("dense").checked && !inside;
    dense.material.uniforms.pixels.value = devicePixelRatio;
    dense.material.uniforms.focal.value = h / 2 / Math.tan(orbit.fov / 360 * Math.PI);
  }
  cloud.material.uniforms.size.value = Math.max(2.4, Math.min(w, h) / 270);   // of the screen
  cloud.material.uniforms.pixels.value = devicePixelRatio;
  cloud.material.uniforms.reach.value = orbit.position.distanceTo(controls.target);
  travel.visible = $("cameras").checked && !inside;
  floorGrid.visible = $("grid").checked && !inside;
  clear(now);
  if (travel.visible && cams[state.step]) now.add(
    lines(frustum(cams[state.step], room.radius / 9), css("--mark"), 2.5));
  renderer.render(scene, cam);
  drawLabels(cam);
  drawCorner();
  drawMeasure(cam);
  placePicture(inside);
}

const inkOn = (color) => {                       // black or white: the larger contrast (WCAG)
  const [r, g, b] = color.map((v) => ((v / 255 + 0.055) / 1.055) ** 2.4);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.179 ? "#000" : "#fff";
};
const LABEL_SHIFTS = [-26, -46, 26, 46, -66, 66];  // of changed objects, px: the arrow stays visible
function drawLabels(cam) {                       // nearer labels win where two would overlap
  const taken = [];
  const first = (o) => 8 * (o === state.selected || o === state.ghost)
    + (o.kind || markOf(o) ? RANK.length - rankOf(o) : 0);
  const placed = [...shown(), ...absentHere()].map((o) => [o, project(o.at, cam)])
    .filter(([o, at]) => at && (isFound(o) || first(o) >= 8)).sort(([a, p], [b, q]) => first(b) - first(a) || p[2] - q[2]);
  $("labels").replaceChildren();
  for (const [o, [x, y]] of $("names").checked ? placed : []) {
    if (cam === seat && !o.kind && !o.then && o !== state.selected && !seenAt(o, state.step)) continue;
    const mark = o.kind ? kindText(o) : markOf(o), text = [nameOf(o), mark].filter(Boolean).join(" ");
    const w = 7 * text.length + 8, free = (at) => !taken.some((t) =>
      Math.abs(t[0] - x) < (t[2] + w) / 2 && Math.abs(t[1] - at) < 17);
    const at = (mark ? LABEL_SHIFTS : [0]).map((shift) => y + shift).find(free);
    if (at === undefined) continue;
    taken.push([x, at, w]);
    const chosen = o === state.selected || o === state.ghost ? "selected" : "";
    $("labels").append(el("span", { className: [chosen, mark && (o.kind || changeOf(o).kind)].join(" ").trim(),
      style: `transform: translate(${x}px, ${at}px) translate(-50%, -50%); ${o.kind ? "" : `background: ${rgb(o)}; `
        + `color: ${inkOn(o.color)}`}` }, text));
  }
}

function drawCorner() {                          // scale bar at the turning point; which way is up
  const reach = orbit.position.distanceTo(controls.target);
  const perPixel = 2 * reach * Math.tan(orbit.fov / 360 * Math.PI) / canvas.clientHeight;
  const scale = perUnit(level.metres), long = nice(140 * perPixel * scale), bar = $("bar");
  bar.querySelector("i").style.width = `${long / scale / perPixel}px`;
  bar.querySelector("span").textContent = `${+long.toPrecision(1)} ${unitOf(level.metres)}`;
  const turned = (v) => { V.set(...v).transformDirection(orbit.matrixWorldInverse);
    return [22 * V.x, -22 * V.y]; };
  $("axes").replaceChildren(...[[[1, 0, 0], ""], [[0, 1, 0], ""], [[0, 0, 1], "up"]]
    .flatMap(([axis, text]) => { const [x, y] = turned(axis), up = text === "up";
      const stroke = css(up ? "--mark" : "--dim");
      return [svg("line", { x1: 0, y1: 0, x2: x, y2: y, stroke, "stroke-width": up ? 3 : 1.5 }),
        svg("text", { x: 1.25 * x, y: 1.25 * y }, text)]; }));
}

// ---- What lies under a pixel ----
const ray = new THREE.Raycaster();
function aim(x, y, targets = shown()) {
  const cam = viewpoint(), ndc = [2 * x / canvas.clientWidth - 1, 1 - 2 * y / canvas.clientHeight];
  ray.ray.origin.setFromMatrixPosition(cam.matrixWorld);
  ray.ray.direction.set(...ndc, 0.5).applyMatrix4(cam.projectionMatrixInverse)
    .applyMatrix4(cam.matrixWorld).sub(ray.ray.origin).normalize();
  scene.updateMatrixWorld();
  return ray.intersectObjects(targets.map((o) => o.group.parts.faces), false);
}

const volume = (o) => o.half_axes[0] * o.half_axes[1] * o.half_axes[2];
function pick(x, y) {                            // object under a pixel: of several the smallest,
  const hit = [...new Set(aim(x, y).map((h) => h.object.object))];  // which stands on or in another
  return hit.sort((a, b) => volume(a) - volume(b))[0] || null;
}
