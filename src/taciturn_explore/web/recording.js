// The record of a run: its sentence, its signals and packets over time with the faults above them, and its links. The
// cursor reads values; a range is chosen by dragging, with the buttons, or with the keys.

import { createNetwork } from "./network.js";
import { EDGE, drawPaths, heightOf, sidesOf } from "./paths.js";
import { amount, emphasised, html, number, once, svg } from "./svg.js";
import { picture, save } from "./takeaway.js";

const PANEL = 92; // pixels of a panel
const ROW = 18, ROWS = 8, MOST = 60; // pixels of a row of faults, and the most rows with and without signals
const LETTER = 6.3; // pixels of a letter of a fault
const LEAST = 8; // steps of the closest view
const DRAGGED = 6; // pixels from which on a press is a range

export function mount(outer, found) {
  const host = html("div", { class: "explore recording" });
  outer.className = "explorer";
  outer.replaceChildren(host);
  document.title = `${found.name} · taciturn explore`;
  const last = Math.max(0, ...(found.time.length ? [found.time.length - 1] : found.faults.map((one) => one.to)));
  const time = found.time.length ? found.time : [];
  const state = { at: null, view: [0, last], fault: null };
  const unit = found.unit === "s" ? "s" : "";

  const figure = svg("svg", {
    class: "run", role: "slider", tabindex: 0, "aria-label": "cursor in the run; arrows move it, plus and minus zoom, n and p go to faults",
    "aria-valuemin": found.first, "aria-valuemax": found.first + last,
  });
  const box = html("div", { class: "figure run-figure" }, figure);
  const readout = html("p", { class: "readout", "aria-hidden": "true" });
  const tools = html("div", { class: "tools", role: "group", "aria-label": "View" },
    tool("zoom in", "+", () => zoom(0.5)), tool("zoom out", "−", () => zoom(2)), tool("whole run", "whole run", whole),
    ...(found.faults.length ? [tool("previous fault", "‹ fault", () => jump(-1)), tool("next fault", "fault ›", () => jump(1))] : []));
  const network = createNetwork();
  const overlay = svg("g", { class: "cursor" });
  let drawn = null;

  const [first, ...more] = found.verdict;
  const list = html("div", { class: "fault-list" });
  const section = (name, heading, ...content) => html("section", { class: `card ${name}`, "aria-label": heading }, ...content);
  host.replaceChildren(
    html("header", { class: "bar" }, html("div", {}, html("p", { class: "brand" }, "taciturn"), html("h1", {}, found.name)),
      html("div", { class: "actions" }, ...(last > 1 ? [chip("SVG", () => save("run.svg", picture(figure), "image/svg+xml"))] : []), ...(found.panels.length || found.lanes.length ? [chip("CSV", () => save("run.csv", table(found), "text/csv"))] : []))),
    html("div", { class: "headline" }, html("p", { class: "verdict" }, ...emphasised(first ?? "")), ...more.map((text) => html("p", { class: "more-verdict" }, text))),
    html("main", {},
      last > 1 && (time.length || found.faults.length) ? section("run-card", "Run", html("div", { class: "title-row" }, html("h2", {}, "Run"), legend()), box, html("div", { class: "event-row" }, readout, tools)) : null,
      found.faults.length ? section("fault-card", "Faults", html("h2", {}, "Faults"), list) : null,
      found.links.length ? section("links-card", "Network", html("h2", {}, "Network"), network.host) : null,
      found.table ? section("table-card", "Counters", html("h2", {}, "Counters"), counters(found.table)) : null),
    html("ul", { class: "notes" }, ...found.notes.map((text) => html("li", {}, text))));

  function tool(label, text, act) {
    return html("button", { type: "button", class: "chip", "aria-label": label, title: label, onclick: act }, text);
  }
  function chip(text, act) {
    return html("button", { type: "button", class: "chip", "aria-label": `save as ${text}`, onclick: act }, text);
  }

  function legend() {
    const parts = [];
    if (found.compared) parts.push(html("span", { class: "swatch policy" }), found.compared[0], html("span", { class: "swatch periodic" }), found.compared[1]);
    if (found.lanes.some((one) => one.dropped.length)) parts.push(html("span", { class: "glyph drop" }), "dropped");
    return html("p", { class: "key" }, ...parts);
  }

  // The time of an index, also of a world, which has no times.
  const at = (k) => (time.length ? time[Math.max(0, Math.min(k, last))] : k);
  const until = (one) => (one.to > last ? at(last) : at(one.to));

  // Put the faults into rows in which their names do not overlap.
  function packed(x, right) {
    const ends = [], most = found.panels.length ? ROWS : MOST;
    const order = [...found.faults.keys()].sort((a, b) => found.faults[a].mild - found.faults[b].mild);
    const places = [];
    for (const i of order) {
      const one = found.faults[i];
      const from = Math.max(x.low, x(at(one.from))), to = Math.min(right, x(until(one)));
      if (to < x.low || from > right) continue;
      const wide = LETTER * one.name.length + 10;
      const start = Math.min(from, Math.max(x.low, right - wide)); // the name ends in the figure
      const row = ends.findIndex((end) => end < start - 4);
      const mine = row < 0 ? ends.length : row;
      if (mine >= most) continue;
      ends[mine] = Math.max(to, start + wide);
      places.push({ i, from, to: Math.max(to, from + 2), start, row: mine });
    }
    return { places, rows: ends.length };
  }

  function draw() {
    const width = box.clientWidth;
    if (!width) return;
    const paths = {
      time: time.length ? time : [0, last], unit: found.unit, shown: [at(state.view[0]), at(state.view[1])],
      panels: found.panels.map((one) => ({ ...one, look: one.bound ? "guarantee" : "policy" })),
      lanes: found.lanes.map((one) => ({ ...one, label: `${one.link}: ${amount(one.sent.length, "packet")}${one.known ? `, ${one.dropped.length} dropped` : ""}` })),
      top: EDGE.top,
    };
    const [left, right] = sidesOf(paths.lanes, width);
    const [low, high] = paths.shown;
    const x = (value) => left + ((value - low) / (high - low || 1)) * (right - left);
    x.low = left;
    const { places, rows } = packed(x, right);
    paths.top = 6 + rows * ROW + (paths.panels.length ? 26 : 8);
    const height = heightOf(paths, PANEL);
    box.style.height = `${height}px`;
    drawn = { ...drawPaths(paths, width, height), height, top: paths.top };
    const bands = svg("g", { class: "bands" }), names = svg("g", { class: "faults" });
    for (const { i, from, to, start, row } of places) {
      const one = found.faults[i], y = 6 + row * ROW;
      const look = `${one.mild ? "mild" : ""} ${i === state.fault ? "chosen" : ""}`;
      const bottom = height - EDGE.bottom;
      bands.append(svg("rect", { class: `band ${look}`, x: from, width: to - from, y: y + ROW - 4, height: Math.max(0, bottom - y - ROW + 4) }));
      const group = svg("g", { class: `fault ${look}`, "data-index": i },
        svg("rect", { class: "bar", x: from, width: to - from, y: y + 1, height: ROW - 4, rx: 3 }),
        svg("text", { x: start + 5, y: y + 12 }, one.name), svg("title", {}, one.text));
      group.addEventListener("click", () => choose(i));
      names.append(group);
    }
    figure.setAttribute("viewBox", `0 0 ${width} ${height}`);
    figure.replaceChildren(bands, ...drawn.parts, names, overlay);
    read();
  }
  const redraw = once(draw);

  // The faults at a step.
  const during = (k) => found.faults.filter((one) => one.from <= k && k < Math.max(one.to, one.from + 1));

  function sentence(k) {
    const told = [`step ${found.first + k}`];
    if (unit) told.push(`${number(at(k))} s`);
    for (const lane of found.lanes) if (lane.sets.sent.has(k)) told.push(`${lane.link} ${lane.sets.dropped.has(k) ? "dropped" : "sent"}`);
    for (const one of during(k)) told.push(one.name);
    return told.join(" · ");
  }
  for (const lane of found.lanes) lane.sets = { sent: new Set(lane.sent), dropped: new Set(lane.dropped) };

  // Show the cursor and the values at its step.
  function read() {
    if (!drawn) return;
    const k = state.at;
    for (const { panel, name } of drawn.places) {
      const values = k === null ? [] : [panel.values[k], ...(panel.other ? [panel.other[k]] : [])];
      name.replaceChildren(panel.title, ...values.map((value, i) => svg("tspan", { class: `value ${i ? "periodic" : panel.look}`, dx: 10 }, number(value, 5))));
    }
    overlay.replaceChildren();
    if (k === null) {
      readout.textContent = "point at a step, or press the arrow keys, to read its values; drag to zoom";
      return;
    }
    const px = drawn.x(at(k));
    if (px >= drawn.left - 1 && px <= drawn.right + 1) {
      overlay.append(svg("line", { x1: px, x2: px, y1: drawn.top - 4, y2: drawn.height - EDGE.bottom }));
      for (const { panel, y } of drawn.places) if (Number.isFinite(panel.values[k])) overlay.append(svg("circle", { class: panel.look, cx: px, cy: y(panel.values[k]), r: 3.5 }));
    }
    readout.textContent = sentence(k);
    figure.setAttribute("aria-valuenow", found.first + k);
    figure.setAttribute("aria-valuetext", [sentence(k), ...drawn.places.map(({ panel }) => `${panel.title} ${number(panel.values[k], 5)}`)].join(", "));
  }

  // Move the cursor, and the view with it.
  function go(k, inside = true) {
    state.at = Math.max(0, Math.min(last, k));
    const [from, to] = state.view;
    if (inside && (state.at < from || state.at > to)) {
      const half = (to - from) / 2;
      show(state.at - half, state.at + half);
    } else read();
  }

  function show(from, to) {
    const wide = Math.min(last, Math.max(Math.min(LEAST, last), Math.round(to - from)));
    const start = Math.max(0, Math.min(last - wide, Math.round(from)));
    state.view = [start, start + wide];
    address();
    redraw();
  }

  function whole() {
    state.fault = null;
    mark();
    show(0, last);
  }

  function zoom(by) {
    const [from, to] = state.view, center = state.at !== null && state.at >= from && state.at <= to ? state.at : (from + to) / 2;
    show(center - (center - from) * by, center + (to - center) * by);
  }

  // Choose a fault: its band, its sentence, and a view around it.
  function choose(i) {
    state.fault = i;
    const one = found.faults[i], wide = Math.max(LEAST, one.to - one.from);
    state.at = Math.min(last, one.from);
    mark();
    show(one.from - 1.5 * wide - 10, one.to + 1.5 * wide + 10);
  }

  function jump(by) {
    const many = found.faults.length;
    if (many) choose(state.fault === null ? (by > 0 ? 0 : many - 1) : (state.fault + by + many) % many);
  }

  function mark() {
    for (const [i, one] of [...list.children].entries()) one.setAttribute("aria-pressed", String(i === state.fault));
    list.children[state.fault]?.scrollIntoView?.({ block: "nearest" });
  }

  const address = () => {
    const { view, at: k } = state;
    try { history.replaceState(null, "", `#steps=${view[0]}-${view[1]}${k === null ? "" : `&at=${k}`}`); } catch { /* a page in a frame has no history */ }
  };

  const stepAt = (event) => {
    const value = drawn.x.inverse(event.clientX - figure.getBoundingClientRect().left);
    if (!time.length) return Math.round(value);
    let [low, high] = [0, last];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (time[middle] < value) low = middle + 1;
      else high = middle;
    }
    return low > 0 && value - time[low - 1] < time[low] - value ? low - 1 : low;
  };

  let pressed = null;
  figure.addEventListener("pointerdown", (event) => {
    if (event.button === 0 && !event.target.closest(".fault")) pressed = event.clientX;
  });
  figure.addEventListener("pointermove", (event) => {
    if (!drawn) return;
    go(stepAt(event), false);
    if (pressed === null || Math.abs(event.clientX - pressed) < DRAGGED) return;
    figure.setPointerCapture(event.pointerId);
    const shift = figure.getBoundingClientRect().left, [a, b] = [pressed - shift, event.clientX - shift].sort((one, other) => one - other);
    overlay.append(svg("rect", { class: "range", x: a, width: b - a, y: drawn.top - 4, height: drawn.height - EDGE.bottom - drawn.top + 4 }));
  });
  figure.addEventListener("pointerup", (event) => {
    const begun = pressed;
    pressed = null;
    if (begun === null || Math.abs(event.clientX - begun) < DRAGGED) return;
    const [from, to] = [stepAt({ clientX: begun }), stepAt(event)].sort((one, other) => one - other);
    if (to - from > 1) show(from, to);
  });
  figure.addEventListener("pointercancel", () => { pressed = null; });
  figure.addEventListener("dblclick", whole);
  figure.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const by = event.shiftKey ? 10 : 1, here = state.at ?? state.view[0];
    const act = {
      ArrowLeft: () => go(here - by), ArrowRight: () => go(here + by), Home: () => go(state.view[0]), End: () => go(state.view[1]),
      "+": () => zoom(0.5), "-": () => zoom(2), 0: whole, n: () => jump(1), p: () => jump(-1),
    }[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });

  list.replaceChildren(...found.faults.map((one, i) => html("button", { type: "button", class: `fault-row${one.mild ? " mild" : ""}`, "aria-pressed": "false", onclick: () => choose(i) },
    html("span", { class: "when" }, last > 1 ? `${number(at(one.from))}${one.to - one.from > 1 ? `–${number(until(one))}` : ""}${unit && ` ${unit}`}` : ""),
    html("span", { class: "what" }, html("b", {}, one.name), one.text === one.name ? null : html("span", {}, one.text)))));
  if (found.links.length) {
    network.update({ links: found.links });
    network.rates(found.rates, "step");
  }
  const begun = /^#steps=(\d+)-(\d+)(?:&at=(\d+))?$/.exec(location.hash);
  if (begun && Number(begun[1]) < Number(begun[2]) && Number(begun[2]) <= last) {
    state.view = [Number(begun[1]), Number(begun[2])];
    state.at = begun[3] === undefined ? null : Math.min(last, Number(begun[3]));
  }
  new ResizeObserver(redraw).observe(box);
  return { host };
}

// A table of numbers.
function counters({ head, rows }) {
  const look = (text) => (/[a-z]/i.test(text ?? "") ? "text" : null);
  return html("div", { class: "wide" }, html("table", { class: "numbers" },
    html("thead", {}, html("tr", {}, html("td", {}, head[0]), ...head.slice(1).map((text, i) => html("th", { scope: "col", class: look(rows[0]?.[i + 1]) }, text)))),
    html("tbody", {}, ...rows.map(([name, ...cells]) => html("tr", {}, html("th", { scope: "row" }, name), ...cells.map((text) => html("td", { class: look(text) }, text)))))));
}

// The table of a record: one row for each step.
function table({ time, first, panels, lanes }) {
  const quoted = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const header = ["step", "time", ...panels.map((one) => quoted(one.title)), ...lanes.flatMap((one) => [quoted(`sent ${one.link}`), quoted(`dropped ${one.link}`)])];
  const rows = time.map((at, k) => [first + k, at, ...panels.map((one) => one.values[k] ?? ""), ...lanes.flatMap((one) => [Number(one.sets.sent.has(k)), one.known ? Number(one.sets.dropped.has(k)) : ""])].join(","));
  return [header.join(","), ...rows, ""].join("\n");
}
