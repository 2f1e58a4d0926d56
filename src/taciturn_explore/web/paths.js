// Paths over time: panels with signals, and a lane of packets for each link with its trigger. The response and the record
// of a run draw with this module.

import { line, number, scale, steps, svg, ticks } from "./svg.js";

export const EDGE = { left: 52, right: 18, top: 30, bottom: 42 };
const LANE = 52, LOW = 22; // heights of a lane with and without its trigger
const GAP = 26, LOWEST = 34; // pixels between two panels, and the least height of a panel
const RATIOS = [0.01, 10]; // range of a trigger, relative to its threshold
const USUAL = 0.97; // share of the values of a trigger that its range holds, where it is not relative
const CROSS = 9; // pixels of a cross, below which crosses become bars
const THRESHOLD = "threshold";
const FINEST = 1.5; // points of a curve on a pixel, from which on only the least and the largest of a pixel are drawn

// Return the height that paths need at least.
export function heightOf({ panels, lanes, top = EDGE.top }, each = LOWEST) {
  return top + EDGE.bottom + lanesOf(lanes).height + (each + GAP) * panels.length;
}

// Draw paths. `shown` has the range of times; the result has the elements and where they are.
export function drawPaths({ time, unit, panels, lanes, top: begin = EDGE.top, shown = [time[0] ?? 0, time.at(-1) || 1] }, width, height) {
  const { rows: tall, height: laned } = lanesOf(lanes);
  const each = panels.length ? (height - begin - EDGE.bottom - laned - GAP * panels.length + 8) / panels.length : 0;
  const [left, right] = sidesOf(lanes, width);
  const x = scale(shown, [left, right]);
  const range = within(time, shown);
  const parts = [], rows = [], places = [];
  let top = begin;
  for (const panel of panels) {
    const { y, axis } = vertical(panel, range, [top, top + each], [left, right]);
    parts.push(axis);
    for (const [limit, side] of [[panel.limits && panel.limits[0], 1], [panel.limits && panel.limits[1], -1]]) {
      if (limit === null || limit === undefined) continue;
      const at = Math.max(top, Math.min(top + each, y(limit)));
      parts.push(svg("rect", { class: "limit", x: left, width: right - left, y: side > 0 ? at : top, height: side > 0 ? top + each - at : at - top }));
    }
    const points = (values) => thinned(values, range, right - left).map(([i, value]) => [x(time[i]), y(value)]);
    const path = panel.held ? steps : line;
    if (panel.reference) parts.push(svg("path", { class: "signal reference", d: steps(points(panel.reference)) }));
    if (panel.other) parts.push(svg("path", { class: "signal periodic", d: path(points(panel.other)) }));
    parts.push(svg("path", { class: `signal ${panel.look ?? "policy"}`, d: path(points(panel.values)) }));
    const name = svg("text", { class: "name", x: left, y: top - 6 }, panel.title);
    parts.push(name);
    places.push({ panel, name, y, top, bottom: top + each });
    top += each + GAP;
  }
  top -= panels.length ? 8 : 0;
  for (const [i, lane] of lanes.entries()) {
    const middle = top + (tall[i] === LOW ? 11 : 12);
    parts.push(drawLane(lane, { time, x, range, top, tall: tall[i], middle, left, right }));
    rows.push({ link: lane.link, top, bottom: top + tall[i], middle });
    top += tall[i];
  }
  const axis = svg("g", { class: "axis" });
  for (const tick of ticks(shown, width / 90)) {
    axis.append(svg("line", { x1: x(tick), x2: x(tick), y1: height - EDGE.bottom, y2: height - EDGE.bottom + 4 }));
    axis.append(svg("text", { x: x(tick), y: height - EDGE.bottom + 17, "text-anchor": "middle" }, number(tick)));
  }
  axis.append(svg("text", { x: (left + right) / 2, y: height - 6, "text-anchor": "middle", class: "title" }, unit === "s" ? "time in seconds" : "time in steps"));
  return { parts: [...parts, axis], x, rows, places, left, right, range };
}

// Return the left and the right end of the time axis.
export function sidesOf(lanes, width) {
  const names = [...lanes.map((one) => short(one.link)), ...(lanesOf(lanes).rows.includes(LANE) ? [THRESHOLD] : [])];
  return [Math.max(EDGE.left, 6.4 * Math.max(0, ...names.map((one) => one.length)) + 14), width - EDGE.right];
}

function lanesOf(lanes) {
  const few = lanes.length < 4;
  const rows = lanes.map((one) => (one.trigger && few ? LANE : LOW));
  return { rows, height: rows.reduce((sum, one) => sum + one, 0) + (lanes.length ? 8 : 0) };
}

// The vertical axis of a panel: its scale, and its lines with numbers.
function vertical(panel, [from, to], [top, bottom], [left, right]) {
  let low = Infinity, high = -Infinity;
  for (const values of [panel.values, panel.other, panel.reference]) {
    for (let i = from; values && i <= to; i++) if (Number.isFinite(values[i])) [low, high] = [Math.min(low, values[i]), Math.max(high, values[i])];
  }
  if (low > high) [low, high] = [0, 1];
  const pad = 0.08 * (high - low) || 1;
  [low, high] = [low - pad, high + pad];
  const y = scale([low, high], [bottom, top]), each = bottom - top, axis = svg("g", { class: "axis" });
  let shown = [];
  for (let many = Math.max(1, each / 40); shown.length < 2 && many < 9; many++) shown = ticks([low, high], many);
  if (each < 44) shown = shown.filter((_, i) => i === 0 || i === shown.length - 1);
  for (const tick of shown) {
    axis.append(svg("line", { x1: left, x2: right, y1: y(tick), y2: y(tick), class: tick === 0 ? "zero" : "" }));
    axis.append(svg("text", { x: left - 8, y: y(tick) + 4, "text-anchor": "end" }, number(tick, 3)));
  }
  return { y, axis };
}

// A lane: a bar for each packet that arrived, a cross for a dropped one, and its trigger below.
function drawLane({ link, sent: packets, dropped: none, timed, trigger, ratio = true, label }, { time, x, range, top, tall, middle, left, right }) {
  const group = svg("g", { class: "lane" });
  const dropped = new Set(none), upper = top + 3;
  group.append(svg("text", { class: "lane-name", x: left - 8, y: middle + 3, "text-anchor": "end" }, short(link)));
  group.append(svg("line", { class: "ground", x1: left, x2: right, y1: middle, y2: middle }));
  const marks = (steps, mark) => {
    let text = "", last = "";
    for (const k of steps) {
      if (k < range[0] || k > range[1]) continue;
      const at = x(time[k]).toFixed(1);
      if (at !== last) text += mark(Number(at));
      last = at;
    }
    return text;
  };
  const sent = marks(packets.filter((k) => !dropped.has(k)), (at) => `M${at} ${middle}V${upper}`);
  const gone = packets.filter((k) => dropped.has(k) && k >= range[0] && k <= range[1]);
  const dense = gone.length > (right - left) / CROSS; // then a bar below the line is read more easily than a cross
  const lost = marks(gone, (at) => (dense ? `M${at} ${middle + 1}v5` : `M${at - 3} ${middle - 6}l6 6m0 -6l-6 6`));
  group.append(svg("path", { class: "packets policy", d: sent }), svg("path", { class: "packets lost", d: lost }),
    svg("path", { class: "packets periodic", d: timed ? marks(timed, (at) => `M${at} ${middle + 1}v5`) : "" }));
  if (trigger && tall === LANE) {
    const sizes = trigger.slice(range[0], range[1] + 1).filter(Number.isFinite).map(Math.abs).sort((a, b) => a - b);
    const most = sizes[Math.floor(USUAL * (sizes.length - 1))] || 1;
    const r = ratio ? scale(RATIOS.map(Math.log10), [top + LANE - 4, middle + 12]) : scale([-most, most], [top + LANE - 4, middle + 10]);
    const level = (value) => (Number.isFinite(value) ? r(ratio ? Math.log10(Math.max(RATIOS[0], Math.min(RATIOS[1], value))) : Math.max(-most, Math.min(most, value))) : NaN);
    const points = thinned(trigger, range, right - left).map(([i, value]) => [x(time[i]), level(value)]);
    group.append(svg("line", { class: "threshold", x1: left, x2: right, y1: r(0), y2: r(0) }), svg("path", { class: "trigger", d: line(points) }),
      svg("text", { class: "lane-name", x: left - 8, y: r(0) + 3, "text-anchor": "end" }, THRESHOLD));
  }
  group.append(svg("title", {}, label));
  return group;
}

// The first and the last index of the times in a range, and one more on each side.
function within(time, [low, high]) {
  let [from, to] = [0, Math.max(0, time.length - 1)];
  while (from < to && time[from + 1] < low) from++;
  while (to > from && time[to - 1] > high) to--;
  return [from, to];
}

// Indices and values of a curve; where there are more than a pixel can show, the least and the largest of each pixel.
function thinned(values, [from, to], pixels) {
  const found = [], each = (to - from + 1) / Math.max(1, pixels);
  if (each <= FINEST * 2) {
    for (let i = from; i <= to; i++) found.push([i, values[i] ?? NaN]);
    return found;
  }
  for (let start = from; start <= to; start += each) {
    let least = -1, most = -1;
    for (let i = Math.ceil(start); i < Math.min(to + 1, start + each); i++) {
      if (!Number.isFinite(values[i])) continue;
      if (least < 0 || values[i] < values[least]) least = i;
      if (most < 0 || values[i] > values[most]) most = i;
    }
    if (least < 0) found.push([Math.floor(start), NaN]);
    else for (const i of least < most ? [least, most] : least > most ? [most, least] : [least]) found.push([i, values[i]]);
  }
  return found;
}

export function short(name) {
  return name.length > 12 ? `${name.slice(0, 5)}…${name.slice(-5)}` : name;
}
