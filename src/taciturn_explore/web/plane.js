// The plane of cost against traffic. The point can be dragged along its curve: the position is mapped to the trade-off
// parameter between the points that the library has computed. The numbers that are shown belong to an answer.

import { html, line, number, scale, svg, ticks } from "./svg.js";

const EDGE = { left: 52, right: 18, top: 20, bottom: 42 };
const LEAST = 0.1; // share of the traffic from which on the curve of the policy determines the range of the costs
const LITTLE = 0.04; // distance from the cost of every sample, relative to it, that the range holds in any case
const NEAR = 6; // a rival that is farther from every sample than so many times the policy lies outside of the range
const REACH = 1.3; // of the curve of the policy, relative to the range of the numbers at the point
const ROOM = 1.08;
const ROW = 15; // pixels of a name at the edge
const WIDE = 440; // pixels of a figure with room for names at the right
const LETTER = 6.6; // pixels of a letter of a name
const LEADER = 14; // pixels from the right end of the figure to a name
const END = 0.85; // part of the width of the figure beyond which a curve ends at the right
const SMOOTH = 0.02; // error of a curve, relative to the range of the costs, up to which it is drawn through the point
const KEY = 1.08; // ratio of the parameter before and after an arrow key
export const LOOKS = ["kind-a", "kind-b", "kind-c", "kind-d"]; // classes of the curves of other kinds

// Points on a curve that are a few pixels apart.
function dense(points) {
  const found = [];
  for (let i = 0; i + 1 < points.length; i++) {
    const [[ax, ay], [bx, by]] = [points[i], points[i + 1]];
    const many = Math.max(1, Math.min(200, Math.ceil(Math.hypot(bx - ax, by - ay) / 5)));
    for (let k = 0; k < many; k++) found.push([ax + ((bx - ax) * k) / many, ay + ((by - ay) * k) / many]);
  }
  return points.length ? [...found, points.at(-1)] : found;
}

const lines = (labels) => labels.filter((one) => one.points.length > 2).flatMap((one) => dense(one.points));
const hit = (box, one) => one[0] > box[0] && one[0] < box[2] && one[1] > box[1] && one[1] < box[3];

export function createPlane(move) {
  const figure = svg("svg", { class: "plane", role: "group", "aria-label": "Cost against traffic" });
  const host = html("div", { class: "figure" }, figure);
  const state = { point: null, periodic: null, curves: new Map(), fair: null, bound: null, pinned: null, tuning: null, ghost: null, domain: null };
  let dragging = false, geometry = null, target = null; // the value to which keys have moved the parameter

  const handle = svg("g", { class: "handle", tabindex: 0, role: "slider" }, svg("circle", { class: "reach", r: 20 }), svg("circle", { class: "halo", r: 13 }), svg("circle", { class: "dot", r: 6.5 }));

  const drawn = svg("g", {});
  handle.setAttribute("display", "none");
  figure.append(drawn, handle);

  function own() {
    const found = [...state.curves.values()].find((curve) => curve.own);
    return found ? found.points : [];
  }

  // The own curve with the present point, in the order of the parameter.
  function path() {
    const points = own().map((one) => ({ ...one }));
    const { point, tuning, domain } = state;
    const noise = Math.max(0, ...points.map((one) => one.error ?? 0)), span = domain ? domain[1] - domain[0] : 0;
    if (point && point.traffic && tuning && points.length && (dragging || noise < SMOOTH * span)) {
      const here = { parameter: point.tuning.value, traffic: point.traffic.value, cost: point.cost.value, guarantee: point.guarantee && point.guarantee.value };
      points.push(here);
    }
    return points.sort((a, b) => a.parameter - b.parameter);
  }

  // The range of the costs holds the policy, every sample, and what is near them: a rival far away would flatten the rest.
  function range(whole) {
    const { point, periodic, bound, pinned } = state;
    const here = point.cost.value, base = point.every ? point.every.cost : here;
    const far = Math.max(Math.abs(here - base), base - Math.min(...own().map((one) => one.cost)), LITTLE * Math.abs(base)) || 1;
    const rivals = [periodic?.value, point.guarantee?.value, point.written?.cost, pinned?.cost.value, bound?.cost].filter((one) => Number.isFinite(one) && Math.abs(one - base) <= NEAR * far);
    let [low, high] = [Math.min(base, here, ...rivals), Math.max(base, here, ...rivals)];
    const span = Math.max(high - low, far), curve = own().filter((one) => one.traffic >= LEAST * whole).map((one) => one.cost);
    high = Math.max(low + span, high, Math.min(Math.max(...curve, high), low + REACH * span));
    low = Math.min(low, ...curve);
    return [low - 0.07 * (high - low), low + ROOM * (high - low)];
  }

  // The names of what lies outside of the range, at the edge, with an arrow and the value.
  function edges(whole, x, y, [top, bottom, left, right], base, mapped, curves) {
    const { point, periodic, pinned } = state, here = point.traffic.value, rows = { up: 0, down: 0 }, found = [];
    const excess = (cost) => base ? `${cost >= base ? "+" : "−"}${number(Math.abs(100 * (cost / base - 1)), 3)} %` : number(cost);
    const add = (text, look, traffic, cost, value) => {
      const at = y(cost), side = at < top - 2 ? "up" : at > bottom + 2 ? "down" : null;
      if (!side) return;
      const words = `${side === "up" ? "↑" : "↓"} ${text} ${value ?? excess(cost)}`, size = 6.4 * words.length;
      const line = side === "up" ? top + 10 + ROW * rows.up++ : bottom - 5 - ROW * rows.down++;
      const end = x(traffic) + 18 + size > right;
      const begin = end ? Math.max(left + 4, Math.min(right, x(traffic) - 18) - size) : x(traffic) + 18;
      const covers = (from) => curves.some((one) => hit([from - 2, line - 11, from + size, line + 4], one));
      let from = begin; // or farther right, where it covers no curve
      while (covers(from) && from + size <= right) from += 6;
      if (from + size > right) from = begin;
      found.push({ look, box: [from - 2, line - 11, from + size, line + 4], node: svg("text", { class: `label edge ${look}`, x: from, y: line }, words) });
    };
    if (periodic) add("periodic", "periodic", here, periodic.value, periodic.above);
    if (point.guarantee) add("guarantee", "guarantee", here, point.guarantee.value, point.guarantee.above);
    if (point.written) add("plant as written", "policy", point.written.traffic, point.written.cost);
    if (pinned?.traffic) add("pinned", "", pinned.traffic.value, pinned.cost.value, pinned.cost.above);
    for (const curve of state.curves.values()) {
      if (curve.own || !curve.points.length || mapped(curve.points).some(([, at]) => at >= top && at <= bottom)) continue;
      const nearest = curve.points.reduce((best, one) => (one.cost < best.cost ? one : best));
      add(`${curve.kind}, at least`, curve.look, nearest.traffic, nearest.cost);
    }
    return found;
  }

  function draw() {
    const width = host.clientWidth, height = host.clientHeight;
    const { point } = state;
    if (!point || !point.traffic) {
      handle.setAttribute("display", "none");
      return drawn.replaceChildren();
    }
    if (!width || !height) return;
    const whole = point.whole ?? Math.max(...own().map((one) => one.traffic), 1.5 * point.traffic.value);
    if (!dragging || !state.domain) state.domain = range(whole);
    const base = point.every && point.every.cost > 0 ? point.every.cost : null;
    const beside = width >= WIDE, shown = [...state.curves.values()].filter((one) => !one.own);
    const longest = Math.max(...["every sample", ...shown.map((one) => one.kind)].map((one) => one.length));
    const margin = beside ? LEADER + LETTER * longest + 4 : EDGE.right;
    const x = scale([0, 1.04 * whole], [EDGE.left, width - margin]);
    const y = scale(state.domain, [height - EDGE.bottom, EDGE.top]);
    geometry = { x, y };
    const [top, bottom, left, right] = [EDGE.top, height - EDGE.bottom, EDGE.left, width - margin];
    const grid = svg("g", { class: "axis" });
    const percent = base ? ticks([(state.domain[0] / base - 1) * 100, (state.domain[1] / base - 1) * 100], height / 52) : null;
    for (const tick of percent ?? ticks(state.domain, height / 52)) {
      const at = y(percent ? base * (1 + tick / 100) : tick);
      grid.append(svg("line", { x1: left, x2: right, y1: at, y2: at, class: percent && tick === 0 ? "zero" : "" }));
      const text = percent ? `${tick > 0 ? "+" : tick < 0 ? "−" : ""}${number(Math.abs(tick))} %` : number(tick);
      grid.append(svg("text", { x: left - 8, y: at + 4, "text-anchor": "end" }, text));
    }
    for (const share of point.whole ? [0, 0.2, 0.4, 0.6, 0.8, 1] : ticks([0, whole], 5).map((one) => one / whole)) {
      const at = x(share * whole);
      grid.append(svg("line", { x1: at, x2: at, y1: bottom, y2: bottom + 4 }));
      grid.append(svg("text", { x: at, y: bottom + 17, "text-anchor": "middle" }, point.whole ? `${Math.round(100 * share)} %` : number(share * whole, 3)));
    }
    const priced = point.traffic_unit.startsWith("traffic");
    grid.append(svg("text", { x: (left + right) / 2, y: height - 6, "text-anchor": "middle", class: "title" }, point.whole ? (priced ? "traffic, priced, compared with every sample" : "packets, compared with every sample") : point.traffic_unit));
    grid.append(svg("text", { x: left - 44, y: 11, class: "title" }, base ? "extra cost, compared with every sample" : `cost ${point.unit}`));

    const body = svg("g", { "clip-path": "url(#plane-clip)" });
    const labels = [];
    const mapped = (points) => points.map((one) => [x(one.traffic), y(one.cost)]);
    if (state.bound && state.bound.cost) {
      const at = (traffic) => state.bound.cost + state.bound.slope * (traffic - state.bound.traffic);
      const [a, b] = [0, 1.04 * whole];
      body.append(svg("path", { class: "never", d: `${line([[x(a), y(at(a))], [x(b), y(at(b))]])}L${x(b)} ${bottom}L${x(a)} ${bottom}Z` }));
    }
    for (const curve of shown) {
      if (curve.points.length < 2) continue;
      const { look } = curve, points = mapped(curve.points);
      body.append(svg("path", { class: `curve ${look}`, d: line(points) }));
      labels.push({ text: curve.kind, class: look, points });
    }
    if (state.fair && state.fair.points && state.fair.points.length) {
      const points = mapped([...state.fair.points].sort((a, b) => a.traffic - b.traffic));
      body.append(svg("path", { class: "curve periodic", d: line(points) }));
      labels.push({ text: state.kind === "periodic" ? "best periodic" : "periodic", class: "periodic", points });
    }
    const along = path();
    const proved = along.filter((one) => one.guarantee).map((one) => [x(one.traffic), y(one.guarantee)]);
    if (proved.length > 1) {
      body.append(svg("path", { class: "curve guarantee", d: line(proved) }));
      labels.push({ text: "guarantee", class: "guarantee", points: [...proved].sort((a, b) => a[0] - b[0]) });
    }
    if (along.length > 1) {
      const points = along.map((one) => [x(one.traffic), y(one.cost)]);
      body.append(svg("path", { class: "curve policy", d: line(points) }));
      labels.push({ first: 1, text: "this policy", class: "policy", points: [...points].sort((a, b) => a[0] - b[0]) });
    }
    const marks = svg("g", {});
    const taken = [], outside = edges(whole, x, y, [top, bottom, left, right], base, mapped, lines(labels));
    if (point.every) {
      marks.append(svg("circle", { class: "every", cx: x(whole), cy: y(point.every.cost), r: 4.5 }));
      if (beside) labels.push({ text: "every sample", class: "", points: [[x(whole), y(point.every.cost)], [x(whole) + 7, y(point.every.cost)]] });
      else {
        const at = y(point.every.cost) + 19;
        marks.append(svg("text", { class: "label", x: x(whole), y: at, "text-anchor": "end" }, "every sample"));
        taken.push([x(whole) - LETTER * "every sample".length, at - 11, x(whole), at + 4]);
      }
    }
    if (point.written && y(point.written.cost) >= top && y(point.written.cost) <= bottom) {
      const at = [x(point.written.traffic), y(point.written.cost)];
      marks.append(svg("circle", { class: "written", cx: at[0], cy: at[1], r: 4.5 }));
      const last = at[0] > (left + right) / 2;
      marks.append(svg("text", { class: "label written-name", x: at[0] + (last ? -9 : 9), y: at[1] + 4, "text-anchor": last ? "end" : "start" }, "plant as written"));
      taken.push(last ? [at[0] - 120, at[1] - 9, at[0], at[1] + 6] : [at[0], at[1] - 9, at[0] + 120, at[1] + 6]);
    }
    const { pinned } = state;
    if (pinned && pinned.traffic && y(pinned.cost.value) >= top && y(pinned.cost.value) <= bottom) {
      marks.append(svg("line", { class: "between", x1: x(pinned.traffic.value), y1: y(pinned.cost.value), x2: x(point.traffic.value), y2: y(point.cost.value) }));
      marks.append(svg("circle", { class: "pinned", cx: x(pinned.traffic.value), cy: y(pinned.cost.value), r: 6 }));
      labels.push({ text: "pinned", class: "", points: [[x(pinned.traffic.value) + 4, y(pinned.cost.value)], [x(pinned.traffic.value) - 4, y(pinned.cost.value)]] });
    }
    const here = [x(point.traffic.value), y(point.cost.value)];
    if (state.periodic) {
      const at = y(state.periodic.value);
      if (at > top && at < bottom) {
        marks.append(svg("line", { class: "gap", x1: here[0], x2: here[0], y1: here[1], y2: at }));
        marks.append(svg("circle", { class: "same", cx: here[0], cy: at, r: 3.5 }));
      }
    }
    const ended = beside ? labels.filter((one) => reach(one, left, right, top, bottom)) : [];
    const unnamed = labels.filter((one) => !ended.includes(one) && (one.class !== "guarantee" || !outside.some((other) => other.look === one.class))); // its name is at the edge
    const ghost = state.ghost ? [x(state.ghost.traffic), y(state.ghost.cost)] : here;
    const level = Math.max(top, Math.min(bottom, ghost[1])); // a curve may lead out of the range
    handle.setAttribute("transform", `translate(${ghost[0].toFixed(1)} ${level.toFixed(1)})`);
    const clip = svg("clipPath", { id: "plane-clip" }, svg("rect", { x: left, y: top - 2, width: right - left, height: bottom - top + 2 }));
    figure.setAttribute("viewBox", `0 0 ${width} ${height}`);
    drawn.replaceChildren(svg("defs", {}, clip), grid, body, marks, svg("g", { class: "labels" }, ...column(ended, left, right, top, bottom), ...place(unnamed, left, right, top, bottom, here, [...taken, ...outside.map((one) => one.box)]), ...outside.map((one) => one.node)));
    handle.removeAttribute("display");
    name();
  }

  // The last visible point of a curve that goes on to the right end of the figure.
  function reach(label, left, right, top, bottom) {
    const [px, py] = dense(label.points).filter(([px, py]) => px <= right && py >= top && py <= bottom).at(-1) ?? [-Infinity, 0];
    return px > left + END * (right - left) ? [px, py] : null;
  }

  // The labels of curves at their right ends, below each other, each with a line that leads to it. They have the order of
  // the curves in the middle of the figure, as curves that meet at the end have none there.
  function column(labels, left, right, top, bottom) {
    const far = ([px]) => Math.abs(px - (left + right) / 2);
    const high = (label) => dense(label.points).reduce((best, one) => (far(one) < far(best) ? one : best))[1];
    const found = labels.map((label) => ({ label, end: reach(label, left, right, top, bottom), high: high(label) })).sort((a, b) => a.high - b.high);
    const middle = found.reduce((sum, one) => sum + one.end[1], 0) / Math.max(1, found.length);
    const first = Math.max(top + 8, Math.min(bottom - 4 - ROW * (found.length - 1), middle - (ROW * (found.length - 1)) / 2));
    return found.flatMap(({ label, end: [px, py] }, i) => {
      const at = first + ROW * i;
      return [
        svg("path", { class: `leader ${label.class}`, d: line([[px, py], [right + 2, py], [right + LEADER - 3, at]]) }),
        svg("text", { class: `label ${label.class}`, x: right + LEADER, y: at + 4 }, label.text),
      ];
    });
  }

  // Put the label of each other curve next to it, where it is free of other labels and of all curves: that of another kind
  // near its upper end, and the others near their right ends.
  function place(labels, left, right, top, bottom, here, edges) {
    const curves = lines(labels);
    const taken = [[here[0] - 16, here[1] - 16, here[0] + 16, here[1] + 16], ...edges], found = [];
    const free = (box) => box[0] >= left && box[2] <= right && box[3] < bottom && !curves.some((one) => hit(box, one))
      && taken.every((one) => box[2] < one[0] || box[0] > one[2] || box[3] < one[1] || box[1] > one[3]);
    for (const label of [...labels].sort((a, b) => (b.first ?? 0) - (a.first ?? 0))) {
      const size = LETTER * label.text.length + 2;
      let spot = null;
      const lowest = label.class.startsWith("kind") ? (top + bottom) / 2 : bottom;
      for (const [px, py] of label.class.startsWith("kind") ? dense(label.points) : dense(label.points).reverse()) {
        if (py < top + 2 || py > lowest || spot) continue;
        for (const at of [[px + 7, py + 4], [px + 5, py - 6], [px - size - 6, py + 12], [px - size - 6, py + 4]]) {
          const y = Math.max(top + 10, at[1]);
          if (free([at[0] - 3, y - 11, at[0] + size, y + 4])) { spot = [at[0], y]; break; }
        }
      }
      if (!spot) continue;
      taken.push([spot[0] - 4, spot[1] - 13, spot[0] + size, spot[1] + 5]);
      found.push(svg("text", { class: `label ${label.class}`, x: spot[0], y: spot[1] }, label.text));
    }
    return found;
  }

  function name() {
    const { point, tuning } = state;
    handle.setAttribute("aria-label", tuning ? `point of the policy, moved by ${tuning.name}` : "point of the policy");
    if (tuning) handle.setAttribute("aria-valuenow", tuning.value);
    handle.setAttribute("aria-valuetext", `${tuning ? `${tuning.name} ${number(tuning.value)}: ` : ""}${point.verdict.join(". ")}`);
  }

  // The parameter of the point of the own curve that is nearest to a place of the figure.
  function nearest(px, py) {
    const points = path();
    let best = null;
    for (let i = 0; i + 1 < points.length; i++) {
      const [a, b] = [points[i], points[i + 1]];
      const [ax, ay, bx, by] = [geometry.x(a.traffic), geometry.y(a.cost), geometry.x(b.traffic), geometry.y(b.cost)];
      const length = (bx - ax) ** 2 + (by - ay) ** 2;
      const t = length ? Math.max(0, Math.min(1, ((px - ax) * (bx - ax) + (py - ay) * (by - ay)) / length)) : 0;
      const distance = (ax + t * (bx - ax) - px) ** 2 + (ay + t * (by - ay) - py) ** 2;
      if (!best || distance < best.distance) {
        const positive = a.parameter > 0 && b.parameter > 0;
        const parameter = positive ? Math.exp(Math.log(a.parameter) + t * Math.log(b.parameter / a.parameter)) : a.parameter + t * (b.parameter - a.parameter);
        best = { distance, parameter, traffic: a.traffic + t * (b.traffic - a.traffic), cost: a.cost + t * (b.cost - a.cost) };
      }
    }
    return best;
  }

  function rounded(value) {
    return state.tuning.whole ? Math.max(1, Math.round(value)) : Number(value.toPrecision(3));
  }

  function follow(event) {
    const box = figure.getBoundingClientRect();
    const best = nearest(event.clientX - box.left, event.clientY - box.top);
    if (!best) return;
    state.ghost = best;
    draw();
    move(rounded(best.parameter));
  }

  handle.addEventListener("pointerdown", (event) => {
    if (!state.tuning || own().length < 2) return;
    dragging = true;
    handle.setPointerCapture(event.pointerId);
    host.classList.add("dragging");
    event.preventDefault();
    handle.focus();
  });
  handle.addEventListener("focus", () => { target = null; });
  handle.addEventListener("pointermove", (event) => dragging && follow(event));
  const release = () => {
    if (!dragging) return;
    dragging = false;
    host.classList.remove("dragging");
  };
  handle.addEventListener("pointerup", release);
  handle.addEventListener("pointercancel", release);
  handle.addEventListener("keydown", (event) => {
    const { tuning } = state;
    const ahead = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 4, PageDown: -4 }[event.key];
    if (!ahead || !tuning) return;
    event.preventDefault();
    const falls = own().length > 1 ? own()[0].parameter > own().at(-1).parameter : true; // sorted by traffic
    const more = ahead * (falls ? -1 : 1) * (event.shiftKey ? 4 : 1);
    const from = target ?? tuning.value;
    target = rounded(tuning.whole ? from + more : from * KEY ** more);
    move(target);
  });
  new ResizeObserver(draw).observe(host);

  return {
    host,
    figure,
    get dragging() { return dragging; },
    update(changes) {
      Object.assign(state, changes);
      if (changes.pending === false && state.tuning && state.tuning.value === target) target = null;
      draw();
    },
    settle() {
      state.ghost = null;
      state.domain = null;
      draw();
    },
  };
}
