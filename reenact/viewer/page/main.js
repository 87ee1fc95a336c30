// The viewer: puts the session of the server on the stage, and everything that the user does into it.

import { download, json, post, tensors } from "./api.js";
import { Curves } from "./curves.js";
import { Face } from "./face.js";
import { Nudges } from "./nudges.js";
import { Panel, make } from "./panel.js";
import { DETAIL, loadTexture, Stage } from "./stage.js";
import { Follower, Track } from "./tracks.js";
import { Training } from "./training.js";

const MOST_CELLS = 6;
const MOST_CURVES = 6;
const OF_RUN = ["networks", "pairs"]; // methods that ask for a checkpoint
const $ = (id) => document.getElementById(id);
const TITLES = { networks: "networks (this run)", pairs: "pairs of shapes (this run)", file: "its own animation", truth: "truth by name" };
const title = (method) => TITLES[method] ?? method;

const state = {
  frame: 0,
  playing: false,
  loop: true,
  speed: 1,
  wireframe: false,
  reference: "",
  scale: 5,
  cells: [], // {rig, method, track, other, face, weights, element, note}
  active: null,
  curves: [], // shapes of the active rig
};
const dark = matchMedia("(prefers-color-scheme: dark)");
let colors = themeColors();
let dirty = true; // something other than the frame changed
let asked = false; // for a picture
const drawn = { count: 0, since: 0 }; // pictures, since when
let settling = 0; // the timer of a smoother picture
let started = { frame: 0, at: 0 }; // playing, from where and when
let dragging = null; // the slider that is being moved: one step of undo
let keeping = Promise.resolve(); // the last correction on its way

// ---------------------------------------------------------------------------------------------------------------------
// What there is

const session = await json("session.json").catch((error) => fail(error.message));
const { frames, fps } = session.clip;
const rigs = session.rigs.map((rig, index) => ({ ...rig, index, isSource: rig.key === session.source }));
const targets = rigs.filter((rig) => !rig.isSource);
const tracks = new Map();
const nudges = new Nudges(session.nudges.map(nudgeOf).filter((item) => item !== null));
const audio = session.audio ? Object.assign(new Audio("audio.wav"), { preload: "auto" }) : null;

document.title = `${session.clip.name} · Reenact`;
$("subject").textContent = `${rigs.map((rig) => rig.key).join(" → ")} · ${session.clip.name}`;
$("subject").title = $("subject").textContent;

const stage = (() => {
  try {
    return new Stage($("faces"), session.camera, invalidate);
  } catch (error) {
    return fail(`The faces need WebGL 2: ${error.message}; try another browser, or switch its acceleration on`);
  }
})();
const panel = new Panel($("shapes"), { moved: shapeMoved, taken: shapeTaken, curve: toggleCurve });
const curves = new Curves($("curves"), $("playhead"), frames, fps, (frame) => goTo(frame, true), redrawCurves);

say("Loading the rigs");
await Promise.all(rigs.map(async (rig) => {
  const [arrays, texture] = await Promise.all([
    tensors(`rig/${rig.index}`),
    rig.textured ? loadTexture(`texture/${rig.index}`) : null,
  ]);
  rig.face = new Face(arrays);
  rig.texture = texture;
})).catch((error) => fail(error.message));

const sourceTrack = trackOf(rigs[0], "clip");
const follower = new Follower(sourceTrack, nudges, refreshed, say);
rigs.forEach((rig) => addCell(rig, rig.method));
select(state.cells[1] ?? state.cells[0]);
for (const rig of targets) {
  for (const method of rig.methods) {
    if (![...$("reference").options].some((option) => option.value === method)) {
      $("reference").append(make("option", { value: method, textContent: title(method) }));
    }
  }
}
if (targets.length === 0) $("reference").closest("label").hidden = true;
for (const suffix of session.exports) {
  const button = make("button", { type: "button", textContent: suffix.toUpperCase(), title: `The active rig's clip as .${suffix}` });
  button.addEventListener("click", () => exportClip(suffix));
  $("exports").append(button);
}
$("frames").textContent = `/ ${(frames - 1).toLocaleString("en")}`;
$("frame").max = $("scrub").max = frames - 1;
const training = session.run && new Training(session.run, {
  whole: $("training"), text: $("training-text"), bar: $("training-bar"), losses: $("losses"), names: $("loss-names"),
  figure: $("preview"), small: $("preview-small"), large: $("preview-large"), enlarge: $("enlarge"), dialog: $("picture"),
  step: $("preview-step"), at: $("preview-at"),
}, () => colors, renew);
$("kept").textContent = session.kept ? `Corrections are kept in ${session.kept}` : "";
say("");

// ---------------------------------------------------------------------------------------------------------------------
// Cells: a rig by a method

/** The weights of a rig by a method, asked for when they are first needed. */
function trackOf(rig, method, again = false) {
  const key = `${rig.index} ${method}`;
  if (!tracks.has(key) || (again && tracks.get(key).failed)) {
    const track = new Track(rig.index, method, frames, rig.shapes.length);
    tracks.set(key, track);
    if (OF_RUN.includes(method) && session.run.checkpoint === null) {
      track.failed = "Rests until the first checkpoint";
      return track;
    }
    track.load(() => {
      if (track.whole && track !== sourceTrack) followCorrections(track);
      refreshed();
    });
  }
  return tracks.get(key);
}

/** What the source's corrections change on a target. */
function followCorrections(track) {
  const span = nudges.span(rigs[0].index, frames - 1);
  if (span !== null) follower.follow(track, ...span);
}

/** Newer networks: what they make of the clip takes the place of what older ones made. Tells whether all of it is there. */
async function renew(step) {
  session.run.checkpoint = step;
  for (const [key, old] of tracks) {
    if (old.method !== "networks" && !(old.method === "pairs" && old.failed)) continue;
    const fresh = new Track(old.rig, old.method, frames, old.shapes);
    await fresh.load(() => {});
    if (fresh.failed) return false;
    tracks.set(key, fresh);
    for (const cell of state.cells) if (cell.track === old) cell.track = fresh;
    followCorrections(fresh);
  }
  refreshed();
  say(`The networks of step ${step.toLocaleString("en")} move the faces now`);
  return true;
}

function addCell(rig, method) {
  const cell = { rig, method, track: trackOf(rig, method), other: null, face: stage.add(rig.face, rig.texture) };
  cell.weights = new Float32Array(rig.shapes.length);
  cell.otherWeights = new Float32Array(rig.shapes.length);
  cell.element = make("div", { className: "cell" });
  const label = make("div", { className: "label" });
  label.append(make("span", { className: "name", textContent: rig.key }));
  if (rig.isSource) {
    label.append(make("span", { className: "role", textContent: "source" }));
  } else {
    cell.select = make("select", { title: "Method" });
    cell.select.setAttribute("aria-label", `Method for ${rig.key}`);
    cell.select.append(...rig.methods.map((each) => make("option", { value: each, textContent: title(each) })));
    cell.select.value = method;
    cell.select.addEventListener("change", () => setMethod(cell, cell.select.value));
    const more = make("button", { type: "button", className: "small", textContent: "+", title: "Compare with another method" });
    more.setAttribute("aria-label", `Compare ${rig.key} by another method`);
    more.addEventListener("click", () => compare(cell));
    const less = make("button", { type: "button", className: "small less", textContent: "×", title: "Close" });
    less.setAttribute("aria-label", `Close this view of ${rig.key}`);
    less.addEventListener("click", () => closeCell(cell));
    label.append(cell.select, more, less);
  }
  cell.note = make("p", { className: "note" });
  cell.element.append(label, cell.note);
  $("cells").append(cell.element);
  state.cells.push(cell);
  arrange();
  return cell;
}

function compare(cell) {
  const taken = state.cells.filter((other) => other.rig === cell.rig).map((other) => other.method);
  const method = ["truth", "shape-matching", ...cell.rig.methods].find((each) => cell.rig.methods.includes(each) && !taken.includes(each));
  const place = state.cells.indexOf(cell) + 1;
  const added = addCell(cell.rig, method ?? cell.method);
  state.cells.splice(place, 0, state.cells.pop());
  stage.cells = state.cells.map((each) => each.face);
  cell.element.after(added.element);
  arrange();
  select(added);
}

function closeCell(cell) {
  state.cells = state.cells.filter((other) => other !== cell);
  stage.remove(cell.face);
  cell.element.remove();
  arrange();
  if (state.active === cell) select(state.cells.find((other) => other.rig === cell.rig));
}

function setMethod(cell, method) {
  cell.method = cell.select.value = method;
  cell.track = trackOf(cell.rig, method, true);
  arrange();
  refreshed();
}

/** Puts the cells in their places, and says which can be closed and which is edited. */
function arrange() {
  stage.resize(state.cells.length);
  $("cells").style.setProperty("--columns", stage.columns);
  state.cells.forEach((cell, n) => {
    cell.element.classList.toggle("edge", n % stage.columns === 0);
    const alone = state.cells.filter((other) => other.rig === cell.rig).length === 1;
    const less = cell.element.querySelector(".less");
    if (less) less.hidden = alone;
    const more = cell.element.querySelector(".small:not(.less)");
    if (more) more.disabled = state.cells.length >= MOST_CELLS;
  });
  const legend = $("which").firstElementChild;
  $("which").replaceChildren(legend, ...state.cells.map((cell) => {
    const label = make("label");
    const several = state.cells.filter((other) => other.rig === cell.rig).length > 1;
    const text = several ? `${cell.rig.key}, ${title(cell.method)}` : cell.rig.key;
    const radio = make("input", { type: "radio", name: "which", checked: cell === state.active });
    radio.addEventListener("change", () => select(cell));
    label.append(radio, make("span", { textContent: text, title: text }));
    return label;
  }));
  invalidate();
}

/** Makes a cell the one that sliders, curves and exports are about. */
function select(cell) {
  const same = state.active?.rig === cell.rig;
  state.active = cell;
  $("which").querySelectorAll("input").forEach((radio, n) => (radio.checked = state.cells[n] === cell));
  if (!same) {
    panel.fill(cell.rig.shapes);
    state.curves = [];
    applyFilter();
  }
  refreshed();
}

/** Something arrived or changed: notes, curves and faces follow. */
function refreshed() {
  for (const cell of state.cells) {
    cell.other = state.reference && !cell.rig.isSource && cell.rig.methods.includes(state.reference)
      ? trackOf(cell.rig, state.reference) : null;
    if (cell.other?.failed) say(`${title(state.reference)}: ${cell.other.failed}`);
    const { track } = cell;
    const waits = !track.whole && !track.failed;
    const share = Math.floor((100 * track.ready) / frames);
    cell.note.textContent = track.failed ?? (waits ? (share ? `${share} % retargeted` : `Preparing ${title(cell.method)} …`) : "");
    cell.note.classList.toggle("wrong", track.failed !== null);
    cell.element.setAttribute("aria-busy", String(waits));
    cell.stale = true;
  }
  if (state.active && state.curves.length === 0 && state.active.track.whole) {
    state.curves = busiest(state.active.track, 2);
    applyFilter();
  }
  redrawCurves();
  showNudges();
  invalidate();
}

/** The shapes that move most. */
function busiest(track, count) {
  const motion = motionOf(track);
  return [...motion.keys()].filter((shape) => motion[shape] > 0).sort((a, b) => motion[b] - motion[a]).slice(0, count);
}

function motionOf(track) {
  const motion = new Array(track.shapes).fill(0);
  const step = Math.max(1, Math.floor(frames / 4000)); // enough to tell what moves
  for (let frame = step; frame < frames; frame += step) {
    const before = track.row(frame - step), here = track.row(frame);
    for (let shape = 0; shape < motion.length; shape++) motion[shape] += Math.abs(here[shape] - before[shape]);
  }
  return motion;
}

// ---------------------------------------------------------------------------------------------------------------------
// Drawing

function invalidate() {
  dirty = true;
  wake();
}

function wake() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(tick);
}

function tick() {
  asked = false;
  const before = state.frame;
  if (state.playing) advance();
  if (state.playing) wake();
  if (state.frame === before && !dirty) return; // a screen is faster than most clips
  dirty = false;
  clearTimeout(settling);
  settling = 0;
  stage.setDetail(state.playing ? DETAIL.playing : DETAIL.moving);
  draw();
  if (state.playing) countFrame();
  else if (stage.software) settling = setTimeout(settle, 250);
}

function settle() {
  settling = 0;
  stage.setDetail(DETAIL.still);
  draw();
}

function draw() {
  if (!state.active) return;
  const { frame } = state;
  for (const cell of state.cells) {
    if (cell.drawnFrame !== frame || cell.stale) pose(cell, frame);
  }
  const ink = dark.matches ? [0.72, 0.74, 0.78] : [0.2, 0.21, 0.24];
  stage.paint({ background: colors.stage, ink, wireframe: state.wireframe, scale: state.scale });
  stage.draw();
  curves.mark(frame);
  $("scrub").value = frame;
  if (document.activeElement !== $("frame")) $("frame").value = frame;
  $("time").textContent = `${(frame / fps).toFixed(2)} s`;
  panel.show(state.active.weights, nudges.at(state.active.rig.index, frame)?.shapes, state.playing);
}

function pose(cell, frame) {
  cell.drawnFrame = frame;
  cell.stale = false;
  cell.track.shown(frame, nudges, cell.weights);
  const other = cell.other?.whole ? (cell.otherWeights.set(cell.other.row(frame)), cell.otherWeights) : null;
  const mean = cell.face.pose(cell.weights, other);
  if (mean !== null && cell.track.whole) cell.note.textContent = `${mean.toFixed(2)} mm in the mean`;
}

function countFrame() {
  drawn.count++;
  const now = performance.now();
  if (now - drawn.since < 1000) return;
  $("time").title = `${Math.round((1000 * drawn.count) / (now - drawn.since))} frames a second drawn`;
  [drawn.count, drawn.since] = [0, now];
}

dark.addEventListener("change", () => {
  colors = themeColors();
  redrawCurves();
  training?.draw();
  invalidate();
});

function themeColors() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  return {
    stage: read("stage"), soft: read("soft"), line: read("line"), accent: read("accent"), ink: read("ink"),
    curves: [0, 1, 2, 3, 4, 5].map((n) => read(`c${n}`)),
    font: `11px ${getComputedStyle(document.body).fontFamily}`,
  };
}

new ResizeObserver(() => {
  stage.resize(state.cells.length);
  $("cells").style.setProperty("--columns", stage.columns);
  state.cells.forEach((cell, n) => cell.element.classList.toggle("edge", n % stage.columns === 0));
  draw(); // at once: resizing empties the canvas
}).observe($("stage"));
new ResizeObserver(redrawCurves).observe($("curves"));

// ---------------------------------------------------------------------------------------------------------------------
// Time

function play(on) {
  if (on && state.frame >= frames - 1) state.frame = 0;
  state.playing = on;
  document.body.classList.toggle("playing", on);
  $("play").setAttribute("aria-label", on ? "Pause" : "Play");
  started = { frame: state.frame, at: performance.now() };
  [drawn.count, drawn.since] = [0, performance.now()];
  if (audio) {
    audio.playbackRate = state.speed;
    if (on) playSound();
    else audio.pause();
  }
  if (!on) $("shapes").querySelectorAll(".shape").length && panel.show(state.active.weights, null, false);
  invalidate();
}

function playSound() {
  audio.currentTime = Math.min(state.frame / fps, audio.duration || Infinity);
  audio.play().catch(() => {}); // a browser may refuse sound until the page is touched; the faces play all the same
}

/** The frame of this moment, by the sound where it plays. */
function advance() {
  const heard = audio && !audio.paused && !audio.ended && audio.currentTime > 0;
  const now = performance.now();
  if (heard) started = { frame: audio.currentTime * fps, at: now };
  let frame = Math.floor(started.frame + ((now - started.at) / 1000) * state.speed * fps + 1e-6);
  if (frame >= frames) {
    if (!state.loop) {
      state.frame = frames - 1;
      play(false);
      return;
    }
    frame %= frames;
    started = { frame, at: now };
    state.frame = frame;
    if (audio) playSound();
  }
  state.frame = frame;
  if (curves.zoomed) curves.follow(frame);
}

/** Shows a frame; the user's own steps stop the playing, a click in the curves goes on from there. */
function goTo(frame, keepPlaying = false) {
  if (!keepPlaying && state.playing) play(false);
  state.frame = Math.min(Math.max(Math.round(frame), 0), frames - 1);
  started = { frame: state.frame, at: performance.now() };
  if (audio && state.playing) playSound();
  if (curves.zoomed) curves.follow(state.frame);
  showNudges();
  invalidate();
}

// ---------------------------------------------------------------------------------------------------------------------
// Corrections

function shapeMoved(shape, value, done) {
  if (state.playing) play(false);
  const { rig, method } = state.active;
  const { frame } = state;
  if (!state.active.track.whole) {
    say("This clip is still being retargeted; correct it when it is there");
    return refreshed();
  }
  if (dragging !== shape) {
    nudges.begin();
    dragging = shape;
  }
  nudges.set(rig.index, frame, shape, value, nudges.at(rig.index, frame)?.radius ?? radius(), method);
  if (done) dragging = null;
  corrected(rig, done ? nudges.span(rig.index, frames - 1) : [frame, frame], !done);
  if (!state.curves.includes(shape)) toggleCurve(shape);
}

function shapeTaken(shape) {
  const { rig } = state.active;
  if (!nudges.at(rig.index, state.frame)?.shapes.has(shape)) return;
  change(rig, () => nudges.remove(rig.index, state.frame, shape));
}

/** A change that undo takes back; what it frees is retargeted too. */
function change(rig, make) {
  const before = nudges.span(rig.index, frames - 1);
  nudges.begin();
  make();
  corrected(rig, around(before, nudges.span(rig.index, frames - 1)), false);
}

function corrected(rig, span, quick) {
  if (rig.isSource && span !== null) {
    for (const track of tracks.values()) if (track.whole) follower.follow(track, ...span, quick);
  }
  if (!quick) keep();
  refreshed();
}

function stepBack(step) {
  const before = nudges.span(0, frames - 1);
  dragging = null;
  if (!step()) return;
  corrected(rigs[0], around(before, nudges.span(0, frames - 1)), false);
}

function around(a, b) {
  if (a === null || b === null) return a ?? b;
  return [Math.min(a[0], b[0]), Math.max(a[1], b[1])];
}

/** Sends the corrections to where they are kept: at once, one sending after the other. */
function keep() {
  if (session.kept === null) return;
  const document = { format: "reenact nudges 1", rigs: {}, nudges: nudges.items.map(entryOf) };
  for (const rig of rigs) document.rigs[rig.key] = rig.shapes;
  keeping = keeping.then(() => post("nudges", JSON.stringify(document))).then(
    () => ($("kept").textContent = `Corrections are kept in ${session.kept}`),
    (error) => say(`Not kept: ${error.message}`),
  );
}

function entryOf(item) {
  const rig = rigs[item.rig];
  const track = tracks.get(`${item.rig} ${item.method}`);
  const row = (each) => Array.from(each.shown(item.frame, nudges, new Float32Array(each.shapes)));
  if (track?.whole) item.weights = row(track);
  if (sourceTrack.whole) item.sourceWeights = row(sourceTrack);
  return {
    clip: session.clip.name, fps, frame: item.frame, radius: item.radius, source: session.source, rig: rig.key,
    method: item.method, weights: item.weights, source_weights: item.sourceWeights,
    shapes: Object.fromEntries([...item.shapes].map(([shape, value]) => [rig.shapes[shape], value])),
  };
}

/** What was kept, as the page has it; null for a frame that the clip no longer has. */
function nudgeOf(entry) {
  const rig = rigs.find((each) => each.key === entry.rig);
  if (entry.frame >= frames) return null;
  const shapes = new Map(Object.entries(entry.shapes).map(([name, value]) => [rig.shapes.indexOf(name), value]));
  return {
    rig: rig.index, frame: entry.frame, radius: entry.radius, method: entry.method, shapes,
    weights: entry.weights, sourceWeights: entry.source_weights,
  };
}

function radius() {
  return Number($("radius").value);
}

function showNudges() {
  if (!state.active) return;
  const index = state.active.rig.index;
  const here = nudges.at(index, state.frame);
  const items = nudges.of(index);
  const list = $("nudges");
  const text = items.map((item) => `${item.frame}${item === here ? "!" : ""} ${item.shapes.size}`).join();
  if (list.dataset.text !== text) {
    list.dataset.text = text;
    list.replaceChildren(...items.map((item) => {
      const button = make("button", { type: "button", textContent: `${item.frame}`, className: item === here ? "here" : "" });
      const names = [...item.shapes.keys()].map((shape) => state.active.rig.shapes[shape]).join(", ");
      button.title = names;
      button.setAttribute("aria-label", `Go to the correction at frame ${item.frame}: ${names}`);
      button.addEventListener("click", () => goTo(item.frame));
      const entry = make("li");
      entry.append(button);
      return entry;
    }));
    if (items.length === 0) list.append(make("li", { textContent: "Move a slider to correct this frame" }));
    if (here) {
      const button = make("button", { type: "button", textContent: "Take back" });
      button.setAttribute("aria-label", `Take back the correction at frame ${here.frame}`);
      button.addEventListener("click", () => change(state.active.rig, () => nudges.remove(index, state.frame)));
      const entry = make("li");
      entry.append(button);
      list.append(entry);
    }
  }
  if (here && document.activeElement !== $("radius")) $("radius").value = here.radius;
  $("radius-text").textContent = `± ${here?.radius ?? radius()} frames`;
  $("undo").disabled = nudges.past.length === 0;
  $("redo").disabled = nudges.future.length === 0;
}

async function exportClip(suffix) {
  const { rig, track } = state.active;
  if (!track.whole) return say("The clip is not there yet; wait until it is");
  const name = `${rig.key}-${track.method}.${suffix}`.replace(/[^\w.-]+/g, "-");
  await keeping;
  await download(`export/${rig.index}/${suffix}`, track.all(nudges), name).catch((error) => say(error.message));
}

// ---------------------------------------------------------------------------------------------------------------------
// Curves

function toggleCurve(shape) {
  if (state.curves.includes(shape)) state.curves = state.curves.filter((other) => other !== shape);
  else state.curves = [...state.curves, shape].slice(-MOST_CURVES);
  redrawCurves();
}

function redrawCurves() {
  const cell = state.active;
  if (!cell) return;
  const lines = [];
  const legend = [];
  const shown = new Map(state.curves.map((shape, n) => [shape, colors.curves[n]]));
  for (const [shape, color] of shown) {
    const name = cell.rig.shapes[shape];
    if (cell.other?.whole) lines.push({ values: cell.other.column(shape), color, dash: [4, 4], width: 1.2 });
    else if (nudges.points(cell.rig.index, shape)) lines.push({ values: cell.track.column(shape), color, dash: [2, 3], width: 1 });
    lines.push({ values: cell.track.column(shape, nudges), color });
    legend.push([name, color, ""]);
  }
  if (cell.other?.whole) legend.push([title(state.reference), "var(--soft)", "dashed"]);
  const source = rigs[0].shapes.indexOf(cell.rig.shapes[state.curves.at(-1)]);
  if (!cell.rig.isSource && source >= 0 && sourceTrack.whole) {
    lines.unshift({ values: sourceTrack.column(source, nudges), color: colors.soft, width: 1 });
    legend.push([`source ${rigs[0].shapes[source]}`, "var(--soft)", "thin"]);
  }
  curves.draw(lines, nudges.of(cell.rig.index).map((item) => item.frame), colors);
  curves.mark(state.frame);
  panel.mark(shown);
  $("shown-curves").replaceChildren(...legend.map(([name, color, kind]) => {
    const entry = make("li");
    const line = make("i", { className: kind });
    line.style.setProperty("--color", color);
    entry.append(line, name);
    return entry;
  }));
  $("fit").hidden = !curves.zoomed;
}

// ---------------------------------------------------------------------------------------------------------------------
// What the user touches

function applyFilter() {
  const on = $("moving").getAttribute("aria-pressed") === "true";
  const moving = on && state.active.track.whole ? motionOf(state.active.track).map((each) => each > 1e-3) : null;
  panel.filter($("search").value, moving);
}

function pressed(button, on = button.getAttribute("aria-pressed") !== "true") {
  button.setAttribute("aria-pressed", String(on));
  return on;
}

function say(text) {
  $("status").textContent = text;
  clearTimeout(say.timer);
  if (text && !text.startsWith("Loading")) say.timer = setTimeout(() => ($("status").textContent = ""), 8000);
}

/** Says why nothing can be shown, and stops. */
function fail(text) {
  $("status").textContent = text;
  throw new Error(text);
}

function setReference(method) {
  $("reference").value = state.reference = method;
  $("legend").hidden = !method;
  $("legend-title").textContent = `Distance to ${title(method)}`;
  refreshed();
}

function look(view) {
  $("view").value = view;
  stage.look(view);
  invalidate();
}

function toggleWireframe() {
  state.wireframe = pressed($("wireframe"));
  invalidate();
}

function nextMethod() {
  const cell = state.active.rig.isSource ? state.cells[1] : state.active;
  if (!cell) return;
  const { methods } = cell.rig;
  setMethod(cell, methods[(methods.indexOf(cell.method) + 1) % methods.length]);
}

function nextNudge(direction) {
  const frames_ = nudges.of(state.active.rig.index).map((item) => item.frame);
  const ordered = direction > 0 ? frames_ : frames_.reverse();
  const found = ordered.find((frame) => direction * (frame - state.frame) > 0);
  if (found !== undefined) goTo(found);
}

$("play").addEventListener("click", () => play(!state.playing));
$("first").addEventListener("click", () => goTo(0));
$("back").addEventListener("click", () => goTo(state.frame - 1));
$("next").addEventListener("click", () => goTo(state.frame + 1));
$("last").addEventListener("click", () => goTo(frames - 1));
$("scrub").addEventListener("input", () => goTo(Number($("scrub").value)));
$("frame").addEventListener("change", () => goTo(Number($("frame").value) || 0));
$("speed").addEventListener("change", () => {
  state.speed = Number($("speed").value);
  if (state.playing) play(true);
});
$("loop").addEventListener("click", () => (state.loop = pressed($("loop"))));
$("sound").hidden = audio === null;
$("sound").addEventListener("click", () => (audio.muted = !pressed($("sound"))));
$("view").addEventListener("change", () => look($("view").value));
$("reference").addEventListener("change", () => setReference($("reference").value));
$("scale").addEventListener("change", () => {
  state.scale = Number($("scale").value);
  invalidate();
});
$("wireframe").addEventListener("click", toggleWireframe);
$("help-button").addEventListener("click", () => $("help").showModal());
$("search").addEventListener("input", applyFilter);
$("moving").addEventListener("click", () => {
  pressed($("moving"));
  applyFilter();
});
$("fit").addEventListener("click", () => curves.fit());
$("undo").addEventListener("click", () => stepBack(() => nudges.undo()));
$("redo").addEventListener("click", () => stepBack(() => nudges.redo()));
$("radius").addEventListener("input", () => {
  const item = nudges.at(state.active.rig.index, state.frame);
  if (item) {
    if (dragging !== "radius") nudges.begin();
    dragging = "radius";
    nudges.setRadius(nudges.at(item.rig, item.frame), radius());
  }
  refreshed();
});
$("radius").addEventListener("change", () => {
  if (dragging === "radius") corrected(state.active.rig, nudges.span(state.active.rig.index, frames - 1), false);
  dragging = null;
});

const KEYS = {
  " ": () => play(!state.playing),
  ArrowLeft: (event) => goTo(state.frame - (event.shiftKey ? 10 : 1)),
  ArrowRight: (event) => goTo(state.frame + (event.shiftKey ? 10 : 1)),
  Home: () => goTo(0),
  End: () => goTo(frames - 1),
  ",": () => nextNudge(-1),
  ".": () => nextNudge(1),
  l: () => $("loop").click(),
  1: () => look("front"),
  2: () => look("three-quarter"),
  3: () => look("side"),
  a: () => stage.turn(-0.12, 0),
  d: () => stage.turn(0.12, 0),
  w: () => stage.turn(0, 0.12),
  s: () => stage.turn(0, -0.12),
  "+": () => stage.turn(0, 0, 0.9),
  "=": () => stage.turn(0, 0, 0.9),
  "-": () => stage.turn(0, 0, 1 / 0.9),
  f: toggleWireframe,
  e: () => targets.length && setReference(state.reference ? "" : $("reference").options[1].value),
  m: nextMethod,
  "/": () => $("search").focus(),
};

document.addEventListener("keydown", (event) => {
  if (document.querySelector("dialog[open]")) return;
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z" && !isText(event.target)) {
    event.preventDefault();
    stepBack(() => (event.shiftKey ? nudges.redo() : nudges.undo()));
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || isText(event.target)) return;
  // Arrows move a slider or a choice that has the focus; a space presses a button.
  const own = event.target.closest("input, select");
  if (own && /^(Arrow|Home|End|Page)/.test(event.key)) return;
  if (event.key === " " && event.target.closest("button, select, summary, input:not([type=range])")) return;
  const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!act || (event.target.closest("select") && event.key.length === 1)) return;
  event.preventDefault();
  act(event);
});

function isText(element) {
  return element.matches("input[type=search], input[type=number]");
}

invalidate();

/** For tests and measurements: what is shown, and milliseconds that a frame takes to bend and draw. */
window.viewer = {
  state,
  session,
  nudges,
  audio,
  stage,
  training,
  software: stage.software,
  get idle() {
    return [...tracks.values()].every((track) => track.whole || track.failed) && !follower.busy;
  },
  get still() {
    return !state.playing && !asked && !dirty && !settling;
  },
  measure(count = 60) {
    const from = state.frame;
    stage.setDetail(DETAIL.playing);
    state.playing = true;
    const begun = performance.now();
    for (let n = 0; n < count; n++) {
      state.frame = Math.floor((n * frames) / count);
      draw();
      stage.finish();
    }
    const each = (performance.now() - begun) / count;
    state.playing = false;
    goTo(from);
    return each;
  },
};
