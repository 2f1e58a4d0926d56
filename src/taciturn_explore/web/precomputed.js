// A page without a server: its answers are in the file. A move ends at the nearest setting that has answers.

import { mount } from "./explore.js";
import { html } from "./svg.js";

export function open(host, { settings, shared, first, key }) {
  const texts = new Map(settings.map((one) => [one.answers[0].setting, one]));

  function nearest(value) {
    const far = (one) => Math.abs(Math.log(one.value / value));
    return settings.reduce((best, one) => (far(one) < far(best) ? one : best));
  }

  const transport = {
    ask(request, take, ended) {
      let whole = true;
      queueMicrotask(() => {
        if (!whole) return;
        const value = request.changes[key];
        if (value !== undefined && !(value > 0)) {
          take({ answer: "refused", setting: "", sentence: `${key} is ${value === "" ? "empty" : value}; expected a number above 0` });
          return ended(null);
        }
        const parts = Object.keys(request.parts).length > 0;
        const one = value > 0 ? nearest(value) : texts.get(request.text) ?? settings[first];
        const { setting } = one.answers[0];
        for (const answer of [...one.answers, ...shared.map((other) => ({ ...other, setting })), { answer: "done", setting }]) if (whole) take(answer);
        if (whole) ended(parts ? "this page was saved and holds one parameter; taciturn explore computes all other changes" : null);
      });
      return () => { whole = false; };
    },
    file: async (text) => texts.get(text).file,
    address: {
      read: () => location.hash.slice(1),
      write: (text) => { try { history.replaceState(null, "", `#${text}`); } catch { /* a page in a frame has no history */ } },
      link: () => location.href,
      opens: "it opens where this file is",
    },
  };
  const begin = transport.address.read();
  const page = mount(host, transport, texts.has(begin.split("&pin=")[0]) ? begin : settings[first].answers[0].setting, [], settings[first].answers[0].setting);
  page.host.classList.add("saved");
  for (const one of page.host.querySelectorAll("#kind, #seed, #steps")) one.disabled = true;
  page.host.querySelector(".tools").remove();
  page.host.append(html("p", { class: "dim" }, `A saved page with ${settings.length} settings. Every number was computed by the library.`));
  if (new URLSearchParams(location.search).has("plane")) { // in a frame of another page, which gives it the height that it tells
    page.host.classList.add("alone");
    page.host.querySelector(".drawer").open = true;
    new ResizeObserver(() => parent.postMessage({ height: page.host.offsetHeight }, "*")).observe(page.host);
  }
}
