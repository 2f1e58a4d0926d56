// What can be taken away: the problem file, Python, the command, figures, a table, and the link.

import { html } from "./svg.js";

export function save(name, text, type) {
  const link = html("a", { href: URL.createObjectURL(new Blob([text], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

const KEPT = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-dasharray", "stroke-linejoin", "stroke-opacity", "opacity", "font-size", "font-family", "font-weight"];

// Return a figure as a file, in which each element has the style that the page gives it.
export function picture(figure) {
  const copy = figure.cloneNode(true);
  const [from, to] = [[figure, ...figure.querySelectorAll("*")], [copy, ...copy.querySelectorAll("*")]];
  from.forEach((one, i) => {
    const style = getComputedStyle(one);
    for (const name of KEPT) if (style.getPropertyValue(name)) to[i].setAttribute(name, style.getPropertyValue(name));
    to[i].removeAttribute("class");
  });
  const [, , width, height] = figure.getAttribute("viewBox").split(" ");
  copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  copy.setAttribute("width", width);
  copy.setAttribute("height", height);
  for (const one of copy.querySelectorAll("[tabindex]")) one.remove();
  return new XMLSerializer().serializeToString(copy);
}

// A cell of a table; a text with a comma or a quote stands in quotes.
function cell(value) {
  return /[",\n]/.test(value) ? `"${value.replaceAll('"', '""')}"` : value;
}

// Return the table of a path: one row for each step.
export function table(found) {
  const links = Object.keys(found.policy.sent);
  const header = ["time", ...found.outputs, ...found.inputs, ...links.map((link) => `sent ${link}`)].map(cell);
  const sent = links.map((link) => new Set(found.policy.sent[link]));
  const columns = [found.time, ...found.policy.outputs, ...found.policy.inputs];
  const rows = found.time.map((_, k) => [...columns.map((column) => column[k]), ...sent.map((one) => Number(one.has(k)))].join(","));
  return [header.join(","), ...rows, ""].join("\n");
}

// Return the table of the plane: one row for each point of a curve, and the point of the policy.
export function points({ point, curves, fair }) {
  const rows = [["curve", "parameter", "traffic", "cost", "guarantee"]];
  rows.push(["this policy", point.tuning?.value ?? "", point.traffic?.value ?? "", point.cost.value, point.guarantee?.value ?? ""]);
  for (const curve of curves.values()) for (const one of curve.points) rows.push([curve.kind || "this kind", one.parameter, one.traffic, one.cost, one.guarantee ?? ""]);
  for (const one of fair?.points ?? []) rows.push(["periodic", "", one.traffic, one.cost, ""]);
  return [...new Set(rows.map((row) => row.join(",")))].join("\n") + "\n"; // two curves may have a point in common
}

export function createTakeaway(state) {
  const dialog = html("dialog", { class: "takeaway", "aria-label": "Take away" });
  const told = html("p", { class: "told", role: "status" });
  const copy = async (text, what, more = "") => {
    try {
      await navigator.clipboard.writeText(text);
      told.textContent = `${what} copied${more && `: ${more}`}`;
    } catch {
      told.replaceChildren(`${what}: select and copy the text${more && ` (${more})`}`, html("pre", { tabindex: 0 }, text));
    }
  };
  const block = (title, text, note) => html("section", {},
    html("h3", {}, title, html("button", { type: "button", class: "chip", onclick: () => copy(text, title) }, "copy")),
    html("pre", { tabindex: 0 }, text), note ? html("p", { class: "dim" }, note) : null);

  return {
    dialog,
    open() {
      const { point, response, plane, transport, text, curves, fair } = state();
      if (!point) return;
      const button = (label, act) => html("button", { type: "button", class: "chip", onclick: act }, label);
      told.textContent = "";
      const saved = point.command.includes("saved.toml") || point.python.includes("saved.toml");
      dialog.replaceChildren(
        html("header", {}, html("h2", {}, "Take away"), html("button", { type: "button", class: "chip", "aria-label": "close", onclick: () => dialog.close() }, "×")),
        html("div", { class: "files" },
          transport.file ? button("problem file", async () => {
            try {
              save("saved.toml", await transport.file(text), "application/toml");
            } catch (error) {
              told.textContent = error.message;
            }
          }) : null,
          button("plane, SVG", () => save("plane.svg", picture(plane), "image/svg+xml")),
          button("plane, CSV", () => save("plane.csv", points({ point, curves, fair }), "text/csv")),
          response.data ? button("response, SVG", () => save("response.svg", picture(response.figure), "image/svg+xml")) : null,
          response.data ? button("response, CSV", () => save("response.csv", table(response.data), "text/csv")) : null,
          button("link", () => copy(transport.address.link(), "link", transport.address.opens))),
        block("Shell", point.command, saved ? "prints the numbers of this page for the problem file, which is saved as saved.toml" : "prints the numbers of this page, digit by digit"),
        block("Python", point.python),
        told);
      dialog.showModal();
    },
  };
}
