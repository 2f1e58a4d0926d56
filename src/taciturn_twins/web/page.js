// The live page of a run. It receives the events, stores the rows of the round, and draws them at most ten times per
// second, using at most a fifth of the time. The charts of a new round replace the old charts when its first row arrives.

import { Curves, format, legend, scaled } from "./curves.js";
import { Drawing, drawPlane, drawRaster } from "./drawings.js";
import { at, post } from "./requests.js";

const $ = (id) => document.getElementById(id);
const SILENCE = 6000; // milliseconds without an event after which the connection is lost; events come every 2 s
const LINES = 200; // largest number of lines in the list of events
const KEPT = 50000; // number of rows stored of a long round
const RECENT = 200; // number of steps in the trigger chart; with more, a crossing of the threshold would be invisible

let round = null; // round that is drawn: {about, rows, others}
let coming = null; // next round, before its first row
let waiting = null, since = 0; // text about the current preparation, and the time when it began
let panels = {};
let link = "lost", paused = false, dirty = false, next = 0;

// Connection to the run.

let source = null, heard = 0;

function connect() {
  source?.close();
  source = new EventSource(at("events"));
  heard = Date.now();
  const on = (kind, act) => source.addEventListener(kind, (event) => {
    heard = Date.now();
    act(JSON.parse(event.data));
  });
  let anew = true; // a new source repeats the whole round; a reconnection by the browser only sends the missed events
  source.onopen = () => {
    if (anew) $("events").querySelector("ol").replaceChildren();
    anew = false;
    setLink("connected");
  };
  source.onerror = () => { if (link !== "ended") setLink("lost"); };
  on("wait", (text) => {
    if (text === null) { clear(); round = coming = null; paused = false; }
    [waiting, since] = [text ?? "waiting for the first round", Date.now()];
    showStatus();
  });
  on("begin", begin);
  on("tick", (row) => {
    if (coming) enter();
    if (round.rows.push(row) > 2 * KEPT) round.rows.splice(0, KEPT);
    plan();
  });
  on("compared", (row) => {
    const { others } = coming ?? round;
    if (others.push(row) > 2 * KEPT) others.splice(0, KEPT);
    plan();
  });
  on("picture", (newest) => { camera.wanted = newest; camera.load(); });
  on("note", ({ text, step }) => note(text, step ?? undefined));
  on("asked", hear);
  on("end", () => setLink("ended"));
  on("alive", () => {});
}

setInterval(() => {
  const silent = Date.now() - heard;
  if (waiting) showStatus();
  if (silent > SILENCE || (source.readyState === EventSource.CLOSED && silent > 1000)) {
    if (link !== "ended") setLink("lost");
    connect();
  }
}, 1000);

function setLink(state) {
  link = state;
  showStatus();
}

function showStatus() {
  const begun = coming ?? round;
  const state = link !== "connected" ? link : waiting ? "waiting" : paused ? "paused" : "connected";
  const degraded = round?.rows.at(-1)?.degraded ? ", degraded operation" : "";
  const text = { waiting: "preparing", lost: "connection lost, reconnecting" }[state] ?? state + degraded;
  if ($("status").textContent !== text) $("status").textContent = text; // avoid repeated screen reader output
  $("status").dataset.state = state;
  const seconds = Math.round((Date.now() - since) / 1000);
  const prepares = waiting ? `${waiting}${seconds ? ` (${seconds} s)` : ""}` : text;
  $("waiting").hidden = Boolean(round);
  $("waiting").textContent = prepares;
  document.querySelector("main").hidden = !round;
  if (waiting && round) $("progress").textContent = prepares;
  $("controls").hidden = !begun;
  for (const id of ["parameter", "pause", "push"]) $(id).disabled = link !== "connected" || !begun;
  if (begun && !begun.about.pauses) $("pause").disabled = true;
  $("pause").textContent = paused ? "Resume" : "Pause";
  $("pause").setAttribute("aria-pressed", String(paused));
}

// The camera: after a picture has been loaded, only the newest picture is fetched.

const camera = {
  wanted: 0, shown: 0, busy: false,
  load() {
    if (this.busy || this.wanted === this.shown) return;
    this.busy = true;
    this.shown = this.wanted;
    $("picture").src = at("picture", { n: this.shown });
  },
  done(came) {
    this.busy = false;
    $("picture").hidden = !came && !$("picture").naturalWidth;
    $("blind").hidden = !$("picture").hidden;
    this.load();
  },
};
$("picture").onload = () => camera.done(true);
$("picture").onerror = () => camera.done(false);

// Rounds.

function clear() {
  for (const panel of Object.values(panels)) panel.close();
  panels = {};
}

function begin(about) {
  coming = { about, rows: [], others: [] };
  paused = false;
  waiting = null;
  $("what").textContent = `${about.robot}, ${about.policy}`;
  document.title = `${about.robot}, ${about.policy} – taciturn`;
  $("progress").textContent = `round ${about.round}`;
  parameter.begin(about);
  showStatus();
}

// Create the charts of the next round after its first row has arrived.
function enter() {
  clear();
  [round, coming] = [coming, null];
  const { about } = round;
  showStatus();
  const sends = about.links.map((name, i) => (
    { name: `${name} packets`, color: ["third", "ink"][i] ?? "bound", look: i ? "disc" : "ring" }));
  const every = { name: "every sample", color: "other", look: "thin" };
  const path = [
    { name: "true", color: "true", look: "solid" }, { name: "estimate", color: "estimate", look: "dashed" }, every,
    ...(about.reference.length ? [{ name: "reference", color: "reference", look: "dotted" }] : []),
  ];
  const looks = [["true", "solid"], ["estimate", "dashed"], ["third", "dotted"]];
  const styled = (names) => names.map((name, i) => ({ name, color: looks[i % 3][0], look: looks[i % 3][1] }));
  if (about.robot === "omni") {
    legend($("path"), [...path, ...sends]);
    panels.path = new Drawing($("path"), drawPlane);
  } else {
    panels.path = new Curves($("path"), [...path, ...sends]);
  }
  const title = about.robot === "omni" ? "path" : `path: ${about.states[0]} over time [s]`;
  $("path").querySelector("h2").textContent = title;
  panels.input = new Curves($("input"), styled(about.inputs).map((one) => ({ ...one, steps: true })));
  panels.cost = new Curves($("cost"), [
    { name: "event-triggered", color: "true", look: "solid" }, every,
    ...(about.bound === null ? [] : [{ name: "guaranteed mean", color: "bound", look: "dashed" }]),
  ], { lower: 0 });
  panels.packets = new Curves($("packets"), [
    ...styled(about.links), ...about.links.map((name, i) => ({ ...every, look: i ? "dotted" : "thin", name: `${name}, every sample` })),
  ], { lower: 0 });
  panels.raster = new Drawing($("raster"), drawRaster);
  newTrigger(false);
}

function newTrigger(log) {
  panels.trigger?.close();
  panels.trigger = new Curves($("trigger"), [
    { name: "value", color: "true", look: "solid", steps: true },
    { name: "threshold", color: "lost", look: "dashed", steps: true },
  ], { log });
  $("trigger").querySelector("h2").textContent = log ? "trigger (log scale; 0 at the bottom)" : "trigger";
}

// Drawing.

function plan() {
  if (dirty) return;
  dirty = true;
  setTimeout(() => { dirty = false; if (!document.hidden) draw(); }, Math.max(0, next - Date.now()));
}
document.addEventListener("visibilitychange", plan);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  for (const panel of Object.values(panels)) panel.redraw();
});

function draw() {
  if (!round?.rows.length) return;
  const { about, rows, others } = round, began = performance.now();
  const time = rows.map((row) => row.time), of = (pick) => rows.map(pick), last = rows.at(-1);
  const shift = rows.length && others.length ? rows[0].tick - others[0].tick : 0; // the first rows of a long round are removed
  const every = (pick) => rows.map((_, i) => others[i + shift] ? pick(others[i + shift]) : null);
  if (about.robot === "omni") panels.path.set(round);
  else {
    panels.path.set([
      time, of((row) => row.state[0]), of((row) => row.estimate?.[0] ?? null), every((row) => row.state[0]),
      ...(about.reference.length ? [of((row) => about.reference[row.tick]?.[0] ?? null)] : []),
      ...about.links.map((name) => of((row) => row.sent[name] ? row.state[0] : null)),
    ]);
  }
  panels.input.set([time, ...about.inputs.map((_, i) => of((row) => row.input[i]))]);
  panels.cost.set([
    time, of((row) => row.cost), every((row) => row.cost),
    ...(about.bound === null ? [] : [time.map(() => about.bound)]),
  ]);
  panels.packets.set([
    time, ...about.links.map((name) => of((row) => row.packets[name])),
    ...about.links.map((name) => every((row) => row.packets[name])),
  ]);
  panels.raster.set(round);
  const recent = rows.slice(-RECENT);
  const [log, values] = scaled([recent.map((row) => row.trigger), recent.map((row) => row.threshold)]);
  if (log !== panels.trigger.log) newTrigger(log);
  panels.trigger.set([time.slice(-RECENT), ...values]);
  if (!waiting && !coming) {
    $("progress").textContent = `round ${about.round}, ${last.tick + 1} of ${about.ticks} steps, ${format(last.time)} s`;
  }
  showNow(about, last);
  showComparison(about, rows, others);
  showDrops(about, last);
  showStatus();
  next = Date.now() + Math.max(100, 4 * (performance.now() - began)); // limit the share of time for drawing
  document.body.dataset.rows = rows.length;
}

function line(name, ...values) {
  const cells = [document.createElement("th"), ...values.map(() => document.createElement("td"))];
  cells.forEach((cell, i) => { cell.textContent = [name, ...values][i]; });
  const found = document.createElement("tr");
  found.append(...cells);
  return found;
}

// Compare both loops after the latest step that both have completed.
function showComparison(about, rows, others) {
  const step = Math.min(rows.at(-1).tick, others.at(-1)?.tick ?? -1);
  const [own, other] = [rows, others].map((list) => list[step - list[0]?.tick]), both = Boolean(own && other);
  const compared = (name, pick) => {
    const values = both ? [pick(own), pick(other)] : [null, null];
    return line(name, ...values.map(format), values[1] ? `${Math.round(100 * values[0] / values[1])} %` : "–");
  };
  $("compared").textContent = both ? `after ${step + 1} step${step ? "s" : ""}` : "so far";
  $("compare").querySelector("tbody").replaceChildren(
    compared("cost", (row) => row.cost),
    ...about.links.map((name) => compared(`${name} packets`, (row) => row.packets[name])));
}

// Show the packet losses by design, with one sentence per link.
function showDrops(about, row) {
  const told = about.links.map((name, i) => [name, about.losses[i]])
    .filter(([name, loss]) => loss > 0 && row.packets[name])
    .map(([name, loss]) => (
      `${row.drops[name]} of ${row.packets[name]} packets dropped on the ${name} link, as designed (p = ${loss})`));
  $("drops").textContent = told.join("\n") || "no packets dropped by design";
}

function showNow(about, row) {
  $("now").querySelector("tbody").replaceChildren(
    ...about.states.map((name, i) => line(name, format(row.state[i]), format(row.estimate?.[i]))),
    ...about.inputs.map((name, i) => line(name, format(row.input[i]), "")));
}

function note(text, step = round?.rows.at(-1)?.tick) {
  const entry = document.createElement("li"), when = document.createElement("span");
  when.textContent = Number.isInteger(step) ? `step ${step}` : "";
  entry.append(when, text);
  const list = $("events").querySelector("ol");
  list.prepend(entry);
  while (list.children.length > LINES) list.lastChild.remove();
}

// Requests.

const parameter = {
  held: false, value: 0,
  begin({ parameter: [name, least, largest], meaning, value }) {
    // logarithmic scale from the smallest to the largest value; if the smallest is 0, four decades and 0
    const [foot, span] = [least || largest * 1e-4, least ? 0 : 1];
    const between = (step) => foot * (largest / foot) ** ((step - span) / (1000 - span));
    const rounded = (step) => Math.min(Math.max(Number(between(step).toPrecision(3)), least), largest);
    this.read = (step) => step <= 0 ? least : step >= 1000 ? largest : rounded(step);
    const share = (known) => Math.log(known / foot) / Math.log(largest / foot);
    this.write = (known) => known < foot ? 0 : Math.round(span + (1000 - span) * share(known));
    this.value = value;
    $("parameter-name").textContent = name;
    $("meaning").textContent = meaning;
    if (!this.held) $("parameter").value = this.write(value);
    this.say(format(value));
  },
  say(text) {
    $("parameter-value").textContent = text;
    $("parameter").setAttribute("aria-valuetext", text);
  },
};
$("parameter").oninput = () => {
  parameter.held = true;
  parameter.say(`${format(parameter.value)} → ${format(parameter.read(+$("parameter").value))}`);
};
$("parameter").onchange = () => {
  parameter.held = false;
  ask("value", parameter.read(+$("parameter").value));
};
$("pause").onclick = () => ask("pause", paused ? 0 : 1);
$("push").onclick = () => ask("push", 1);
$("controls").onsubmit = (event) => event.preventDefault();

async function ask(what, value) {
  try {
    const answer = await post("ask", { ask: what, value });
    if (!answer.ok) note(`${what} rejected: ${await answer.text()}`);
  } catch {
    note(`${what} failed: the run cannot be reached`);
  }
}

// Show a request of this page or of another page.
function hear({ ask: what, value }) {
  if (what === "pause") {
    paused = value === 1;
    note(paused ? "pause" : "resume");
  } else if (what === "value") {
    if (!parameter.held) {
      $("parameter").value = parameter.write(value);
      parameter.say(value === parameter.value ? format(value) : `${format(parameter.value)} → ${format(value)}`);
    }
    note(`${$("parameter-name").textContent} set to ${format(value)}: the next round starts with it`);
  }
  showStatus();
}

connect();
