// The page of a run: hears the events, keeps the rows of the round, and draws them at most ten times a second and for
// at most a fifth of the time.

import { Curves, format, legend, scaled } from "./curves.js";
import { Drawing, drawPlane, drawRaster } from "./drawings.js";

const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token");
const at = (path, query = {}) => `${path}?${new URLSearchParams({ ...query, ...(token && { token }) })}`;
const SILENCE = 6000; // milliseconds without a word after which the run counts as lost; it speaks every two seconds
const LINES = 200; // of the log
const KEPT = 50000; // rows of an endless round
const RECENT = 200; // ticks of the trigger that are drawn: of more, nobody sees when it passes the threshold

let round = null; // {about, rows}
let panels = {};
let link = "lost", paused = false, dirty = false, next = 0;

// Listening.

let source = null, heard = 0;

function connect() {
  source?.close();
  source = new EventSource(at("events"));
  heard = Date.now();
  const on = (kind, act) => source.addEventListener(kind, (event) => {
    heard = Date.now();
    act(JSON.parse(event.data));
  });
  let anew = true; // then all is told again; when the browser reconnects by itself, only what was missed
  source.onopen = () => {
    if (anew) $("log").querySelector("ol").replaceChildren();
    anew = false;
    setLink("connected");
  };
  source.onerror = () => { if (link !== "ended") setLink("lost"); };
  on("wait", () => { clear(); round = null; paused = false; showStatus(); });
  on("begin", begin);
  on("tick", (row) => { if (round.rows.push(row) > 2 * KEPT) round.rows.splice(0, KEPT); plan(); });
  on("picture", (newest) => { camera.wanted = newest; camera.load(); });
  on("note", note);
  on("asked", hear);
  on("end", () => setLink("ended"));
  on("alive", () => {});
}

setInterval(() => {
  const silent = Date.now() - heard;
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
  const state = link === "connected" ? (round ? (paused ? "paused" : "connected") : "waiting") : link;
  const degraded = round?.rows.at(-1)?.degraded ? ", degraded" : "";
  const text = { waiting: "waiting for a round", lost: "lost, trying again" }[state] ?? state + degraded;
  if ($("status").textContent !== text) $("status").textContent = text; // else it is read aloud again
  $("status").dataset.state = state;
  for (const id of ["knob", "pause", "push"]) $(id).disabled = link !== "connected" || !round;
  $("pause").textContent = paused ? "Go on" : "Pause";
  $("pause").setAttribute("aria-pressed", String(paused));
}

// The camera: only the newest picture is fetched, when the one before has come.

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

// A round.

function clear() {
  for (const panel of Object.values(panels)) panel.close();
  panels = {};
}

function begin(about) {
  clear();
  round = { about, rows: [] };
  paused = false;
  const sends = about.links.map((name, i) => (
    { name: `${name} sends`, color: ["third", "ink"][i] ?? "bound", look: i ? "disc" : "ring" }));
  const path = [
    { name: "true", color: "true", look: "solid" }, { name: "estimate", color: "estimate", look: "dashed" },
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
    { name: "cost", color: "true", look: "solid" },
    ...(about.bound === null ? [] : [{ name: "guaranteed at most", color: "bound", look: "dashed" }]),
  ], { lower: 0 });
  panels.rate = new Curves($("rate"), styled(about.links), { lower: 0, upper: 1.05 });
  panels.raster = new Drawing($("raster"), drawRaster);
  newTrigger(false);
  $("what").textContent = `${about.robot}, ${about.policy}`;
  document.title = `${about.robot}, ${about.policy} – taciturn`;
  knob.begin(about);
  showStatus();
  plan();
}

function newTrigger(log) {
  panels.trigger?.close();
  panels.trigger = new Curves($("trigger"), [
    { name: "value", color: "true", look: "solid", steps: true },
    { name: "threshold", color: "lost", look: "dashed", steps: true },
  ], { log });
  $("trigger").querySelector("h2").textContent = log ? "trigger (log; 0 at the bottom)" : "trigger";
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
  if (!round) return;
  const { about, rows } = round, began = performance.now();
  const time = rows.map((row) => row.time), of = (pick) => rows.map(pick), last = rows.at(-1);
  if (about.robot === "omni") panels.path.set(round);
  else {
    panels.path.set([
      time, of((row) => row.state[0]), of((row) => row.estimate?.[0] ?? null),
      ...(about.reference.length ? [of((row) => about.reference[row.tick]?.[0] ?? null)] : []),
      ...about.links.map((name) => of((row) => row.sent[name] ? row.state[0] : null)),
    ]);
  }
  panels.input.set([time, ...about.inputs.map((_, i) => of((row) => row.input[i]))]);
  panels.cost.set([time, of((row) => row.cost), ...(about.bound === null ? [] : [time.map(() => about.bound)])]);
  panels.rate.set([time, ...about.links.map((name) => of((row) => row.rate[name]))]);
  panels.raster.set(round);
  const recent = rows.slice(-RECENT);
  const [log, values] = scaled([recent.map((row) => row.trigger), recent.map((row) => row.threshold)]);
  if (log !== panels.trigger.log) newTrigger(log);
  panels.trigger.set([time.slice(-RECENT), ...values]);
  const reached = last ? `, tick ${last.tick + 1} of ${about.ticks}, ${format(last.time)} s` : "";
  $("progress").textContent = `round ${about.round}${reached}`;
  if (last) showNow(about, last);
  showStatus();
  next = Date.now() + Math.max(100, 4 * (performance.now() - began)); // a long round leaves time for everything else
  document.body.dataset.rows = rows.length;
}

function showNow(about, row) {
  const line = (name, ...values) => {
    const cells = [document.createElement("th"), ...values.map(() => document.createElement("td"))];
    cells.forEach((cell, i) => { cell.textContent = [name, ...values][i]; });
    const found = document.createElement("tr");
    found.append(...cells);
    return found;
  };
  $("now").querySelector("tbody").replaceChildren(
    ...about.states.map((name, i) => line(name, format(row.state[i]), format(row.estimate?.[i]))),
    ...about.inputs.map((name, i) => line(name, format(row.input[i]), "")));
}

function note(text) {
  const entry = document.createElement("li"), when = document.createElement("time");
  const last = round?.rows.at(-1);
  when.textContent = last ? `${format(last.time)} s` : "";
  entry.append(when, text);
  const list = $("log").querySelector("ol");
  list.prepend(entry);
  while (list.children.length > LINES) list.lastChild.remove();
}

// Asking.

const knob = {
  held: false, value: 0,
  begin({ knob: [name, least, largest], value }) {
    // from the least to the largest value by equal factors; where the least is 0, over four decades above 0
    const [foot, span] = [least || largest * 1e-4, least ? 0 : 1];
    const between = (step) => foot * (largest / foot) ** ((step - span) / (1000 - span));
    const rounded = (step) => Math.min(Math.max(Number(between(step).toPrecision(3)), least), largest);
    this.read = (step) => step <= 0 ? least : step >= 1000 ? largest : rounded(step);
    const share = (known) => Math.log(known / foot) / Math.log(largest / foot);
    this.write = (known) => known < foot ? 0 : Math.round(span + (1000 - span) * share(known));
    this.value = value;
    $("knob-name").textContent = name;
    if (!this.held) $("knob").value = this.write(value);
    this.say(format(value));
  },
  say(text) {
    $("knob-value").textContent = text;
    $("knob").setAttribute("aria-valuetext", text);
  },
};
$("knob").oninput = () => {
  knob.held = true;
  knob.say(`${format(knob.value)} → ${format(knob.read(+$("knob").value))}`);
};
$("knob").onchange = () => {
  knob.held = false;
  ask("value", knob.read(+$("knob").value));
};
$("pause").onclick = () => ask("pause", paused ? 0 : 1);
$("push").onclick = () => ask("push", 1);
$("controls").onsubmit = (event) => event.preventDefault();

async function ask(what, value) {
  const headers = { "Content-Type": "application/json", ...(token && { Authorization: `Bearer ${token}` }) };
  try {
    const answer = await fetch("ask", { method: "POST", headers, body: JSON.stringify({ ask: what, value }) });
    if (!answer.ok) note(`${what} was refused: ${await answer.text()}`);
  } catch {
    note(`${what} was not heard: the run cannot be reached`);
  }
}

// What somebody asked, on this page or on another one.
function hear({ ask: what, value }) {
  if (what === "pause") paused = value === 1;
  if (what === "value" && !knob.held) {
    $("knob").value = knob.write(value);
    knob.say(value === knob.value ? format(value) : `${format(knob.value)} → ${format(value)}`);
  }
  const name = $("knob-name").textContent;
  note({ pause: value ? "pause" : "go on", push: "push", value: `${name} ${format(value)}` }[what]);
  showStatus();
}

connect();
