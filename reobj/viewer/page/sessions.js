// Other recordings of the map: their objects instead of those of this one, and pictures from before.
const EARLIER = S.earlier || [];
const dateOf = (session) => session.date.slice(0, 16).replace("T", " ");
const inMap = (part) => Boolean(S.changes?.components.includes(part));

function objectsThen(session) {                  // as objects of the part, without visits and tracks
  const { origin } = S.parts[state.part];
  return session.objects.map((o) => ({ ...o, center: add(o.center, origin, -1), then: session,
    part: state.part, ids: [o.id], sources: [], color: hue(o.id), status: "ok", reason: "", confidence: null,
    classes: {}, visits: [], seen: [], tracks: [], frames_seen: 0,
    crops: [] }));
}

function enterSession(session) {                 // null: this recording
  select(null);
  Object.assign(state, { session, merging: null, measured: [] });
  hint("");
  $("session").value = EARLIER.indexOf(session);
  CHANGES = session ? kindsOf(session.changes) : SINCE;
  document.body.classList.toggle("then", Boolean(session));
  $("since").textContent = session ? `Objects of ${session.name} (${dateOf(session)} UTC), points and `
    + `cameras of this recording. ${session.summary}` : S.changes?.summary;
}

function switchSession(session) {
  enterSession(session);
  gather();
  if (renderer) fillSolids();
  fillList();
  redraw();
}

function nowOf(o) {                              // what this recording says of an object of another one
  const found = objects.find((x) => x.ids.includes(o.id)), { kind } = SINCE.get(o.id) || {};
  if (!found?.center || found.part !== state.part) return kind ? kind.replace("_", " ") : "not found";
  const way = add(found.center, o.center, -1), d = Math.hypot(...way) * level.size;
  return `${length(d, level.metres)} from here`;
}

// ---- Pictures of the map: of an object of another recording; before and after a change ----
function beforeAfter(id, o) {                    // o: the object that is shown, if there is one
  const shot = (session) => figure(session.pictures[id], session.name,
    `${session.name}, ${dateOf(session).slice(0, 10)}`);
  const session = state.session || EARLIER.findLast((s) => s.pictures[id]);
  if (!session?.pictures[id]) return [];
  if (!state.session && !["moved", "gone"].includes(SINCE.get(id)?.kind)) return [];
  const best = o?.crops.find(([frame]) => frame === o.best) || o?.crops[0];
  return [el("h3", {}, state.session ? "Picture" : best ? "Before and after" : "Before"),
    el("div", { className: "crops pair" }, shot(session),
      ...(best ? [figure(best[1], "this recording", "this recording")] : []))];
}

function startSessions() {                       // without other recordings there is no switch
  if (!EARLIER.length) return;
  $("session").append(el("option", { value: -1 }, `this recording: ${S.changes?.session}`),
    ...EARLIER.map((s, value) => el("option", { value }, `${s.name}, ${dateOf(s)}`)));
  $("session").onchange = () => switchSession(EARLIER[$("session").value] || null);
}
