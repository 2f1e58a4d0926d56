// The page: it turns moves of the user into settings, asks for their answers, and shows the newest ones.
//
// One request is open at a time. A move is sent when the live answers of the request before have arrived, and replaces
// the moves that still wait. An answer is shown only if it belongs to the setting of the open request.

import { createControls } from "./controls.js";
import { createNetwork } from "./network.js";
import { LOOKS, createPlane } from "./plane.js";
import { createResponse } from "./response.js";
import { emphasised, html, once, same } from "./svg.js";
import { createTakeaway } from "./takeaway.js";

const SPOKEN = 700; // milliseconds after which a screen reader hears the verdict
const PIN = "pin";
const NOTES = {
  periodic: "the best periodic control at this rate, with the same measurements", every: "the same control with a packet at every sample",
  guarantee: "proven upper bound", bound: "lower bound on the cost of every schedule of this controller at this rate", difference: "this policy minus the pinned one, on common draws",
};

const OLD = 500; // milliseconds from response and network of a setting to those of another one while a point moves

// Show the page in an element. `begin` is an address, `problems` are names of others, and `given` is the setting of the file.
export function mount(outer, transport, begin, problems = [], given = begin) {
  const host = html("div", { class: "explore" });
  outer.className = "explorer";
  outer.replaceChildren(host);
  // `settled` is the present setting, and `good` the last one of which everything could be shown.
  const state = { text: "", pinned: "", settled: null, good: null, point: null, curves: new Map(), on: "", notes: [], unpinned: [] };
  let open = null, waiting = null, spoken = 0, drawn = 0;

  const plane = createPlane((value) => move({ [state.settled.tuning.key]: value }, {}));
  const response = createResponse((parts) => move({}, parts));
  const network = createNetwork();
  const controls = createControls((changes) => move(changes, {}), (parts) => move({}, parts));
  const takeaway = createTakeaway(() => ({ point: state.point, response, plane: plane.figure, transport, text: state.text, curves: state.curves, fair: state.fair }));

  const verdict = html("p", { class: "verdict" }), further = html("div", {});
  const notes = html("ul", { class: "notes", "aria-label": "Notes" });
  const heard = html("p", { class: "hidden", role: "status", "aria-live": "polite" });
  const sentence = html("p", { class: "sentence", role: "alert", hidden: true });
  const title = html("h1", {});
  const numbers = html("table", { class: "numbers" });
  const busy = html("span", { class: "busy", "aria-hidden": "true" });
  const compare = html("div", { class: "compare", role: "group", "aria-label": "Policy kinds to compare with" });
  const pin = html("button", { type: "button", class: "chip", "aria-pressed": "false", onclick: () => setPin(state.pinned ? "" : state.point.setting) }, "Pin");
  const take = html("button", { type: "button", class: "chip", onclick: () => takeaway.open() }, "Take away");
  const effort = html("p", { class: "effort" });
  const load = html("p", { class: "key" }), disturbed = html("p", { class: "key" });
  const drawer = html("details", { class: "drawer", open: !outer.clientWidth || outer.clientWidth > 760 }, html("summary", {}, "Controls"), controls.host);
  const headline = html("div", { class: "headline" }, verdict, further, heard, sentence, notes);
  const section = (name, heading, ...content) => html("section", { class: name, "aria-label": heading }, ...content);
  host.replaceChildren(
    html("header", { class: "bar" }, html("div", {}, html("p", { class: "brand" }, "taciturn"), title, busy), html("div", { class: "actions" }, pin, take)),
    headline,
    html("main", {},
      section("side", "Controls", drawer),
      section("card plane-card", "Plane", html("div", { class: "title-row" }, html("h2", {}, "Cost against traffic"), disturbed), plane.host, compare, html("div", { class: "numbers-host" }, numbers), effort),
      section("card response-card", "Response", html("div", { class: "title-row" }, html("h2", {}, "Response"), key()), response.host, html("div", { class: "event-row" }, response.tools, response.list)),
      section("card network-card", "Network", html("div", { class: "title-row" }, html("h2", {}, "Network"), load), network.host)),
    takeaway.dialog);

  function key() {
    return html("p", { class: "key" }, html("span", { class: "swatch policy" }), "this policy", html("span", { class: "swatch periodic" }), "periodic, same rate, same noise");
  }

  // A change of the setting by the user.
  function move(changes, parts) {
    waiting = { changes: { ...waiting?.changes, ...changes }, parts: { ...waiting?.parts, ...parts } };
    if (!open || open.live) send();
  }

  // Ask for a setting; `again` after a refusal, whose sentence stays.
  function send(text = state.text, again = false) {
    const { changes, parts } = waiting ?? { changes: {}, parts: {} };
    waiting = null;
    open?.end();
    const mine = open = { live: false, text: "", again, asked: { ...changes, ...parts }, before: state.settled, end: () => {} };
    busy.classList.add("on");
    mine.end = transport.ask({ text, changes, parts, pinned: state.pinned }, (one) => mine === open && hear(mine, one), (error) => {
      if (mine !== open) return;
      busy.classList.remove("on");
      if (error) say(error);
      next(mine);
    });
  }

  // The point has arrived, and if the pictures are old, they too: a waiting move may follow.
  function next(mine) {
    mine.live = true;
    if (waiting) send();
  }

  function hear(mine, one) {
    if (one.answer === "setting") {
      mine.text = one.setting;
      settle(one);
      return;
    }
    if (one.answer === "refused") {
      refuse(mine, one);
      return;
    }
    if (one.setting !== mine.text) return;
    if (one.answer === "point" && !mine.again) allow();
    ({ point: showPoint, response: showResponse, network: showNetwork, curve: showCurve, fair: showFair, bound: showBound, kinds: showKinds, difference: showDifference, beside: showBeside, done: showAll })[one.answer]?.(one);
    if (one.answer === "network") [drawn, state.good] = [performance.now(), state.settled];
    if (one.answer === "network" || (one.answer === "point" && performance.now() - drawn < OLD)) next(mine);
  }

  function settle(settled) {
    state.text = settled.text;
    state.settled = settled;
    host.classList.remove("unopened");
    transport.address.write(settled.text + (state.pinned ? `&${PIN}=${encodeURIComponent(state.pinned)}` : ""));
    name(settled.name);
    document.title = `${settled.name} · taciturn explore`;
    controls.update(settled);
    if (settled.curve !== state.on) {
      state.on = settled.curve;
      state.curves.clear();
      state.fair = state.bound = null;
      headline.style.minHeight = "";
    }
  }

  // Show the name of the problem; where others are known, as a choice.
  function name(present) {
    if (!problems.includes(present)) return title.replaceChildren(present);
    const choice = html("select", { "aria-label": "problem", onchange: () => { waiting = null; send(`problem=${choice.value}`); } }, ...problems.map((one) => html("option", { value: one, selected: one === present }, one)));
    title.replaceChildren(choice);
  }

  // A refusal of bad input leaves the setting before, and stands where the input was made. A loop that is unstable is a
  // setting, of which nothing can be shown.
  function refuse(mine, { sentence: text, unstable }) {
    const shown = mine.text !== "" && state.point?.setting === mine.text;
    const back = !shown && !unstable && mine.before && mine.before.text !== mine.text;
    if (back && mine.text) settle(mine.before);
    if (!back && mine.text) blank(mine.text);
    plane.settle();
    response.forget();
    if (!back || !controls.refuse(mine.asked, text)) say(text);
    mine.live = true;
    busy.classList.remove("on");
    if (waiting) send();
    else if (back && state.all !== state.text) send(state.text, true);
  }

  // Show a sentence, and the way to a setting that has worked, or to the file as it was given.
  function say(text) {
    const all = state.good?.text === state.text && state.point?.setting === state.text, to = state.good?.text ?? given;
    const way = all || to === state.text ? null
      : html("button", { type: "button", class: "chip", onclick: () => { waiting = null; send(to); } }, state.good ? "Back to the last setting" : "Open the file as it was given");
    sentence.replaceChildren(text, ...(way ? [" ", way] : []));
    sentence.hidden = false;
  }

  // Take away the sentences of refusals.
  function allow() {
    sentence.hidden = true;
    controls.allow();
  }

  // Take away all numbers that belong to other settings.
  function blank(text) {
    if (state.point?.setting !== text) {
      state.point = null;
      host.classList.add("blank");
      host.dataset.setting = text;
      delete host.dataset.refined;
      for (const one of [verdict, further, numbers, effort, load, disturbed]) one.replaceChildren();
      clearTimeout(spoken);
      heard.textContent = "";
      showNotes([]);
      plane.update({ point: null });
    }
    if (response.data?.setting !== text) response.update(null);
    if (network.setting !== text) network.update(null);
    pin.disabled = take.disabled = !state.point;
  }

  function showNotes(lines) {
    if (same(lines, state.notes)) return;
    state.notes = lines;
    notes.replaceChildren(...lines.map((one) => html("li", {}, one)));
  }

  function showPoint(point) {
    if (state.point?.refined && !point.refined && state.point.setting === point.setting) return; // it is known better
    pin.disabled = take.disabled = false;
    state.point = point;
    host.classList.remove("blank");
    host.dataset.setting = point.setting;
    host.dataset.refined = point.refined;
    host.classList.toggle("unsettled", !point.settled);
    const [first, ...others] = point.verdict;
    verdict.replaceChildren(...emphasised(first));
    further.replaceChildren(...others.map((line) => html("p", { class: "more-verdict" }, ...emphasised(line))));
    showNotes([...point.notes, ...state.unpinned]);
    clearTimeout(spoken);
    spoken = setTimeout(() => { heard.textContent = point.verdict.join(". "); }, SPOKEN);
    plane.update({ point, periodic: periodic(), kind: state.settled.kind.name, tuning: state.settled.tuning && { ...state.settled.tuning }, curves: state.curves, fair: state.fair, bound: state.bound, pinned: state.pinnedPoint, pending: Boolean(waiting) });
    if (!plane.dragging && !waiting) plane.settle();
    network.rates(point.rates, point.rate_unit);
    load.textContent = point.load ?? "";
    disturbed.textContent = point.by_default ? "with a slow disturbance by default" : "";
    table();
    effort.textContent = [`${point.refined ? "refined" : "first"} answer`, point.method, point.effort, `seed ${state.settled.seed}`].filter(Boolean).join(", ");
    if (sentence.hidden) headline.style.minHeight = `${headline.getBoundingClientRect().height}px`; // a shorter verdict moves nothing
  }

  // Periodic control beside the present point.
  function periodic() {
    const { point, beside } = state;
    return point.periodic ?? (beside && beside.setting === point.setting ? beside.periodic : null);
  }

  const showResponse = (one) => response.update(one);
  const showNetwork = (one) => { network.update(one); network.rates(state.point.rates, state.point.rate_unit); };
  const redraw = once(() => plane.update({ periodic: state.point && periodic(), curves: state.curves, fair: state.fair, bound: state.bound, domain: plane.dragging ? undefined : null }));
  function showCurve(one) { if (one.on === state.on) { state.curves.set(one.own ? "" : one.kind, one.own ? one : { ...one, look: look(state.compared ?? [], one.kind) }); redraw(); } }
  function showFair(one) { if (one.on === state.on) { state.fair = one; redraw(); } }
  function showBound(one) { state.bound = one; redraw(); table(); }
  function showBeside(one) { state.beside = one; redraw(); table(); }
  function showAll() { state.all = state.text; busy.classList.remove("on"); }

  function showKinds({ kinds, compare: usual }, picked = state.settled.compare) {
    controls.kinds(kinds);
    const chosen = new Set((picked ?? usual).filter((name) => name !== state.settled.kind.name));
    state.compared = chosen;
    const names = kinds.map((one) => one.name).filter((name) => name !== state.settled.kind.name);
    for (const name of [...state.curves.keys()]) if (name && !chosen.has(name)) state.curves.delete(name);
    redraw();
    const chip = (name) => html("button", {
      type: "button", class: "chip small", "aria-pressed": String(chosen.has(name)), title: kinds.find((one) => one.name === name).goal,
      onclick: () => {
        const next = chosen.has(name) ? [...chosen].filter((one) => one !== name) : [...chosen, name];
        move({}, { compare: next });
        showKinds({ kinds, compare: usual }, next);
      },
    }, chosen.has(name) ? html("span", { class: `swatch ${look(chosen, name)}`, "aria-hidden": "true" }) : null, name);
    const shown = names.filter((name) => chosen.has(name)), others = names.filter((name) => !chosen.has(name));
    compare.replaceChildren("compared with", ...shown.map(chip), others.length ? html("details", {}, html("summary", { class: "chip small" }, "add…"), html("div", { class: "menu" }, ...others.map(chip))) : "");
  }

  function setPin(text) {
    state.pinned = text;
    state.pinnedPoint = text ? state.point : null;
    state.difference = null;
    state.unpinned = [];
    pin.setAttribute("aria-pressed", String(Boolean(text)));
    pin.textContent = text ? "Unpin" : "Pin";
    network.pin(text && state.point ? state.point.rates : null);
    move({}, {});
    table();
  }

  function showDifference(one) {
    state.difference = one;
    table();
  }

  function table() {
    const { point, bound, pinnedPoint, difference, beside } = state;
    if (!point) return;
    const own = (one) => one && one.setting === point.setting; // a number of another setting is none of this one
    const row = (look, name, cost, above, traffic) => html("tr", { class: look }, html("th", { scope: "row", title: NOTES[look] }, html("span", { class: `swatch ${look}`, "aria-hidden": "true" }), name), html("td", {}, ...estimate(cost)), html("td", {}, above ?? ""), html("td", {}, ...estimate(traffic)));
    const reason = (look, name, text) => html("tr", { class: look }, html("th", { scope: "row", title: NOTES[look] }, html("span", { class: `swatch ${look}`, "aria-hidden": "true" }), name), html("td", { class: "reason", colspan: 3 }, `none: ${text}`));
    const rows = [row("policy", "this policy", point.cost.text, point.cost.above, point.traffic && point.traffic.text)];
    if (pinnedPoint) rows.push(row("pinned", "pinned", pinnedPoint.cost.text, pinnedPoint.cost.above, pinnedPoint.traffic && pinnedPoint.traffic.text));
    if (pinnedPoint) {
      const found = own(difference) && difference.pinned === state.pinned ? difference : null;
      if (found?.reason) rows.push(reason("difference", "difference", found.reason));
      else rows.push(row("difference", "difference", found?.cost ?? "…", "", found?.rates.map((one) => one.text).join(", ")));
    }
    const clock = periodic();
    const none = point.beside ? own(beside) && beside.reason : point.how_periodic;
    if (!clock && none) rows.push(reason("periodic", "periodic", none));
    else if (clock || point.beside) rows.push(row("periodic", "periodic", clock ? clock.text : "…", clock?.above, clock && point.traffic && point.traffic.text));
    if (point.every) rows.push(row("every", "every sample", point.every.text, "", point.every_text));
    if (point.guarantee) rows.push(row("guarantee", "guarantee", point.guarantee.text, point.guarantee.above));
    if (bound && bound.cost) rows.push(row("bound", "no schedule below", own(bound) ? bound.text : "…"));
    numbers.replaceChildren(html("thead", {}, html("tr", {}, html("td", {}), html("th", { scope: "col" }, `cost ${point.unit}`), html("th", { scope: "col" }, "extra cost"), html("th", { scope: "col" }, point.traffic_unit))), html("tbody", {}, ...rows));
  }

  const [text, pinned] = parts(begin);
  if (pinned) {
    transport.ask({ whose: "-pin", only: "point", text: pinned, changes: {}, parts: {}, pinned: "" }, (one) => {
      if (one.answer === "refused") {
        state.unpinned = [`no pinned setting: ${one.sentence}`];
        if (state.point) showNotes([...state.point.notes, ...state.unpinned]);
      }
      if (one.answer !== "point" || (state.pinned && state.pinned !== pinned)) return;
      const again = state.pinnedPoint;
      state.pinned = pinned;
      state.pinnedPoint = one;
      if (again) return table();
      pin.setAttribute("aria-pressed", "true");
      pin.textContent = "Unpin";
      network.pin(one.rates);
      table();
      send(state.text || text);
    }, () => {});
  }
  host.classList.add("unopened");
  pin.disabled = take.disabled = true;
  send(text);
  let wide = 0;
  new ResizeObserver(() => {
    if (outer.clientWidth !== wide) [wide, headline.style.minHeight] = [outer.clientWidth, ""];
  }).observe(outer);

  return {
    host,
    // Show another setting.
    show(address) {
      const [other] = parts(address);
      if (other === state.text || open?.text === other) return;
      waiting = null;
      send(other);
    },
  };
}

// The setting and the pinned setting of an address.
function parts(address) {
  const rest = address.split("&").filter((one) => !one.startsWith(`${PIN}=`));
  return [rest.join("&"), new URLSearchParams(address).get(PIN) ?? ""];
}

// The colour of the curve of a kind, by its place among the kinds that are compared.
function look(chosen, name) {
  return LOOKS[[...chosen].indexOf(name) % LOOKS.length];
}

// An estimate whose error stands back.
function estimate(text) {
  const [value, error] = (text ?? "").split(" ± ");
  return error ? [value, html("span", { class: "pm" }, ` ± ${error}`)] : [value];
}
