// The controls, drawn from the data that the library makes of the records of the policy kinds.

import { active, html, number } from "./svg.js";

const STEPS = 400; // positions of a slider

export function createControls(change, parts) {
  const host = html("form", { class: "controls", "aria-label": "Controls", onsubmit: (event) => event.preventDefault() });
  const kind = html("select", { id: "kind", onchange: () => parts({ kind: kind.value }) });
  const goal = html("p", { class: "goal" });
  const groups = html("div", {});
  const seed = html("input", { id: "seed", type: "number", min: 0, step: 1, onchange: () => parts({ seed: seed.value }) });
  const steps = html("input", { id: "steps", type: "number", min: 20, max: 4000, step: 20, onchange: () => parts({ steps: steps.value }) });
  host.append(
    html("fieldset", {}, html("legend", {}, "Policy"), html("label", { for: "kind", class: "hidden" }, "policy kind"), html("div", { class: "of-kind" }, kind), goal),
    groups,
    html("fieldset", { class: "path" }, html("legend", {}, "Shown path"), html("div", { class: "pair" }, html("label", { for: "seed" }, "seed"), seed, html("label", { for: "steps" }, "steps"), steps)),
  );
  const rows = new Map();
  const fields = { kind, seed, steps };
  let layout = "", now = "", present = null;
  const free = (field) => active(field) !== field && !field.hasAttribute("aria-invalid"); // neither edited nor refused

  const to = (one, at) => one.form === "ratio" ? one.low * (one.high / one.low) ** (at / STEPS) : one.low + (at / STEPS) * (one.high - one.low);
  const from = (one, value) => Math.max(0, Math.min(STEPS, STEPS * (one.form === "ratio" ? Math.log(value / one.low) / Math.log(one.high / one.low) : (value - one.low) / (one.high - one.low || 1))));
  const tidy = (one, value) => one.form === "whole" ? Math.round(value) : Number(value.toPrecision(3));

  // Mark a field with the sentence of a refusal, and with what was given.
  function mark(field, value, text) {
    const id = `refusal-${field.id}`;
    field.value = value;
    field.setAttribute("aria-invalid", "true");
    field.setAttribute("aria-describedby", id);
    const note = html("p", { id, class: "refusal", role: "alert" }, text);
    field.closest(".row, .pair, .of-kind").append(note);
  }

  function row(one) {
    const id = `control-${one.key.replace(/[^\w-]/g, "_")}`;
    if (one.form === "choice") {
      const select = html("select", { id, title: one.note, onchange: () => change({ [one.key]: select.value }) }, ...one.choices.map((word) => html("option", { value: word }, word)));
      return { field: select, node: html("div", { class: "row choice" }, html("label", { for: id, title: one.note }, one.label), select), show: (value) => { select.value = value; } };
    }
    const field = html("input", { id: `${id}-number`, type: "text", inputmode: "decimal", class: "value", "aria-label": `${one.label}, number`, title: one.note });
    const slider = html("input", { id, type: "range", min: 0, max: STEPS, step: one.form === "whole" ? STEPS / Math.max(1, one.high - one.low) : 1, title: one.note });
    const send = (value) => change({ [one.key]: value });
    slider.addEventListener("input", () => {
      const value = tidy(one, to(one, Number(slider.value)));
      field.value = number(value);
      slider.setAttribute("aria-valuetext", field.value);
      send(value);
    });
    field.addEventListener("change", () => {
      const text = field.value.trim().replace("−", "-"), value = Number(text);
      send(text !== "" && Number.isFinite(value) ? value : text); // the library refuses what is no number
    });
    if (one.key.startsWith("factor.")) slider.addEventListener("dblclick", () => send(1));
    return {
      node: html("div", { class: one.tuning ? "row tuning" : "row" }, html("label", { for: id, title: one.note }, one.label), field, slider),
      field,
      show(value) {
        if (free(field)) field.value = number(value);
        if (active(slider) !== slider || !slider.matches(":active")) slider.value = from(one, value);
        slider.setAttribute("aria-valuetext", number(value));
      },
    };
  }

  return {
    host,
    // Show a refusal at the controls that have asked for values; return whether there are such controls.
    refuse(asked, text) {
      this.allow();
      const found = Object.entries(asked).map(([key, value]) => [fields[key] ?? rows.get(key)?.field, value]).filter(([field]) => field);
      for (const [field, value] of found) mark(field, typeof value === "number" ? number(value) : value, text);
      return found.length > 0;
    },
    // Take away the refusals, and show the values of the setting again.
    allow() {
      if (!host.querySelector(".refusal")) return;
      for (const one of host.querySelectorAll(".refusal")) one.remove();
      for (const one of host.querySelectorAll("[aria-invalid]")) for (const name of ["aria-invalid", "aria-describedby"]) one.removeAttribute(name);
      this.update(present);
    },
    update(settled) {
      present = settled;
      const shape = JSON.stringify(settled.controls.map(({ key, form, choices, low, high }) => [key, form, choices, low, high]));
      if (shape !== layout) {
        layout = shape;
        rows.clear();
        const found = new Map();
        for (const one of settled.controls) {
          const built = row(one);
          rows.set(one.key, built);
          if (!found.has(one.group)) found.set(one.group, []);
          found.get(one.group).push(built.node);
        }
        groups.replaceChildren(...[...found].map(([group, nodes]) => group.startsWith("More")
          ? html("details", { class: "more" }, html("summary", {}, group), html("fieldset", {}, html("legend", { class: "hidden" }, group), ...nodes))
          : html("fieldset", {}, html("legend", { class: group === "Policy" ? "hidden" : null }, group), ...nodes)));
      }
      for (const one of settled.controls) rows.get(one.key).show(one.value);
      if (free(seed)) seed.value = settled.seed;
      if (free(steps)) steps.value = settled.steps;
      now = settled.kind.name;
      goal.textContent = settled.kind.goal;
      if (![...kind.options].some((option) => option.value === now)) kind.append(html("option", { value: now }, now));
      kind.value = now;
    },
    kinds(list) {
      const names = list.map((one) => one.name);
      const all = names.includes(now) ? list : [{ name: now, goal: "" }, ...list];
      kind.replaceChildren(...all.map((one) => html("option", { value: one.name, title: one.goal }, one.name)));
      kind.value = now;
    },
  };
}
