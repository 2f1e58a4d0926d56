// The response: outputs and inputs of the policy and of periodic control on the same noise, a lane of packets for each
// link, and its trigger relative to the threshold. A click adds the chosen event; a click on an event removes it.

import { EDGE, drawPaths, heightOf } from "./paths.js";
import { active, amount, html, number, same, svg } from "./svg.js";

const MOST = 4; // outputs or inputs with a panel of their own

export function createResponse(change) {
  const figure = svg("svg", { class: "response", role: "img", "aria-label": "Response" });
  const host = html("div", { class: "figure" }, figure);
  const tools = html("div", { class: "tools", role: "group", "aria-label": "Events" });
  const list = html("div", { class: "events" });
  let found = null, tool = "load", where = "0", geometry = null;
  let wanted = null; // events that have been asked for, until their answer arrives

  function draw() {
    if (!found) return figure.replaceChildren();
    const { time, policy, periodic } = found;
    const paths = {
      time, unit: found.unit,
      panels: [
        ...policy.outputs.slice(0, MOST).map((values, i) => ({ title: found.outputs[i], values, other: periodic && periodic.outputs[i], reference: policy.references[i], held: false })),
        ...policy.inputs.slice(0, MOST).map((values, i) => ({ title: found.inputs[i], values, other: periodic && periodic.inputs[i], limits: found.limits && found.limits[i], held: true })),
      ],
      lanes: Object.entries(policy.sent).map(([link, sent]) => ({
        link, sent, dropped: policy.dropped[link], timed: periodic && periodic.sent[link], trigger: policy.ratios[link],
        label: `${link}: ${amount(sent.length, "packet")}; periodic ${periodic ? periodic.sent[link].length : "–"}`,
      })),
    };
    host.style.minHeight = `${heightOf(paths)}px`;
    const width = host.clientWidth, height = host.clientHeight;
    if (!width || !height) return;
    const { parts, x, rows } = drawPaths(paths, width, height);
    const marks = svg("g", { class: "marks" });
    for (const [i, event] of found.events.entries()) {
      if (event.step >= time.length) continue;
      const at = x(time[event.step]);
      const row = event.kind === "drop" && rows.find((one) => one.link === event.where);
      marks.append(svg("g", { class: `event ${event.kind}`, "data-index": i },
        svg("line", { x1: at, x2: at, y1: row ? row.top : EDGE.top - 18, y2: row ? row.bottom : height - EDGE.bottom }),
        svg("path", { d: row ? "" : `M${at - 5} ${EDGE.top - 24}h10l-5 8z` })));
    }
    geometry = { x, rows, step: (time.at(-1) || 1) / Math.max(1, time.length - 1) };
    figure.setAttribute("viewBox", `0 0 ${width} ${height}`);
    figure.replaceChildren(...parts, marks);
    figure.setAttribute("aria-label", summary());
  }

  function summary() {
    const counts = Object.entries(found.policy.sent).map(([link, sent]) => `${link}: ${amount(sent.length, "packet")}` + (found.periodic ? `, periodic ${found.periodic.sent[link].length}` : ""));
    return `Response over ${number(found.time.at(-1))} ${found.unit}. ${counts.join("; ")}.`;
  }

  const texts = () => wanted ?? found.events.map((one) => [one.kind, text(one)]);
  const ask = (events) => {
    wanted = events;
    change({ events });
  };
  const text = (one) => `${one.step}:${one.where}${one.kind === "drop" ? "" : `:${one.size}`}`;

  figure.addEventListener("click", (event) => {
    if (!found) return;
    const box = figure.getBoundingClientRect(), px = event.clientX - box.left, py = event.clientY - box.top;
    const step = Math.round(geometry.x.inverse(px) / geometry.step);
    const old = found.events.findIndex((one) => Math.abs(geometry.x(found.time[one.step] ?? Infinity) - px) < 6);
    if (old >= 0) return ask(texts().filter((_, i) => i !== old));
    if (step < 0 || step >= found.time.length) return;
    const row = geometry.rows.find((one) => py >= one.top && py <= one.bottom);
    add(row ? "drop" : tool, row ? row.link : where, step);
  });

  // The next step at or after a step in which a packet is sent on a link.
  function sending(link, step) {
    return found.policy.sent[link].find((one) => one >= step) ?? step;
  }

  function add(kind, at, step) {
    const size = kind === "load" ? found.sizes.load[Number(at)] : kind === "step" ? found.sizes.step[Number(at)] : 0;
    if (kind === "drop") step = sending(at, step);
    ask([...texts(), [kind, text({ kind, step, where: at, size })]]);
  }

  function controls() {
    const kinds = [];
    for (const [i, [name]] of found.loads.entries()) kinds.push(["load", String(i), found.loads.length > 1 || name !== "u" ? `load on ${name}` : "load"]);
    for (let i = 0; i < found.set_points; i++) kinds.push(["step", String(i), found.set_points > 1 ? `set-point ${i + 1}` : "set-point"]);
    for (const link of Object.keys(found.policy.sent)) kinds.push(["drop", link, Object.keys(found.policy.sent).length > 1 ? `drop on ${link}` : "drop a packet"]);
    const focused = tools.contains(active(tools)) ? active(tools).dataset.tool : null;
    tools.replaceChildren(...kinds.map(([kind, at, label]) => html("button", {
      type: "button", class: "chip", "data-tool": `${kind}:${at}`, title: "add at a third of the time; a click on the figure adds one there",
      onclick: () => { [tool, where] = [kind, at]; add(kind, at, Math.floor(found.time.length / 3)); },
    }, html("span", { class: `glyph ${kind}`, "aria-hidden": "true" }), label)));
    if (focused) tools.querySelector(`[data-tool="${focused}"]`)?.focus();
    const at = (one) => number((found.time[one.step] ?? one.step) , 3);
    const size = (one) => `${number(one.size, 2)}${one.kind === "load" && found.loads[one.where]?.[1] ? ` ${found.loads[one.where][1]}` : ""}`;
    const words = (one) => `${one.kind}${one.kind === "drop" ? ` on ${one.where}` : ` ${size(one)}`} at ${at(one)} ${found.unit}`;
    list.replaceChildren(...found.events.map((one, i) => html("button", {
      type: "button", class: "chip on", "aria-label": `remove ${words(one)}`,
      onclick: () => ask(texts().filter((_, k) => k !== i)),
      onkeydown: (event) => {
        const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        if (!by) return;
        event.preventDefault();
        const moved = found.events.map((other, k) => k === i ? { ...other, step: Math.max(0, other.step + by * (event.shiftKey ? 10 : 1)) } : other);
        ask(moved.map((other) => [other.kind, text(other)]));
      },
    }, words(one), html("span", { class: "cross", "aria-hidden": "true" }, "×"))));
  }

  new ResizeObserver(draw).observe(host);
  return {
    host, figure, tools, list,
    get data() { return found; },
    // Forget what has been asked for: it was refused.
    forget() { wanted = null; },
    // Show a response. While the point is dragged, the controls stay.
    update(answer) {
      const shown = (one) => one && [one.events, one.set_points, one.loads, Object.keys(one.policy.sent)];
      const alike = same(shown(found), shown(answer));
      found = answer;
      if (!found || same(wanted, found.events.map((one) => [one.kind, text(one)]))) wanted = null;
      draw();
      if (found && !alike) controls();
      if (!found) for (const one of [tools, list]) one.replaceChildren();
    },
  };
}
