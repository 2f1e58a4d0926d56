// The network: one card for each link, with its rate, share, energy, and the intervals between its packets.

import { amount, html, svg } from "./svg.js";

const WIDE = 200, TALL = 46, WIDEST = 44, FEWEST = 10; // of a histogram, pixels of a bar, and its least number of bars

export function createNetwork() {
  const host = html("div", { class: "links" });
  let links = null, rates = null, pinned = null, per = "";

  function histogram({ bars, longest }) {
    const found = svg("svg", { class: "histogram", viewBox: `0 0 ${WIDE} ${TALL}`, preserveAspectRatio: "none", role: "img", "aria-label": bars.length ? `intervals of up to ${amount(longest, "step")} between packets, on a path` : "no intervals between packets" });
    if (!bars.length) return found;
    const most = Math.max(...bars), each = WIDE / Math.max(FEWEST, bars.length);
    found.style.maxWidth = `${Math.max(FEWEST, bars.length) * WIDEST}px`;
    for (const [i, share] of bars.entries()) {
      const high = (share / most) * TALL;
      found.append(svg("rect", { class: i === bars.length - 1 ? "bar more" : "bar", x: i * each + 0.75, width: Math.max(1, each - 1.5), y: TALL - high, height: high }));
    }
    return found;
  }

  function draw() {
    if (!links) return host.replaceChildren();
    host.replaceChildren(...links.links.map((one) => {
      const rate = rates && rates.find((other) => other.link === one.link);
      const before = pinned && pinned.find((other) => other.link === one.link);
      const share = rate && rate.share;
      const meter = svg("svg", { class: "meter", viewBox: "0 0 100 4", preserveAspectRatio: "none", "aria-hidden": "true" }, svg("rect", { class: "track", width: 100, height: 4 }), svg("rect", { class: "fill", width: 100 * Math.min(1, share ?? 0), height: 4 }));
      if (before && before.share !== null) meter.append(svg("rect", { class: "before", x: 100 * before.share - 0.4, width: 0.8, height: 4 }));
      const last = one.bars.length;
      return html("article", { class: "link" },
        html("h3", {}, html("span", {}, one.sender), html("span", { class: "arrow", "aria-label": "to" }, "→"), html("span", {}, one.receiver)),
        html("p", { class: "big" }, rate ? rate.share_text ?? rate.text : "–", html("small", {}, "of the samples")),
        meter,
        html("dl", {},
          ...pair("rate", rate && `${rate.text} per ${per}`),
          ...pair("price", rate && rate.price !== 1 ? String(rate.price) : null),
          ...pair("power", rate && rate.power), ...pair("battery", rate && rate.life),
          ...pair("dropped", one.loss ? `${(100 * one.loss).toFixed(1)} %` : null),
          ...pair("timing", one.delay || null)),
        html("figure", {}, histogram(one), caption(last, rate && rate.apart)));
    }));
  }

  return {
    host,
    get setting() { return links?.setting; },
    update(answer) { links = answer; draw(); },
    rates(found, unit) { [rates, per] = [found, unit]; draw(); },
    pin(found) { pinned = found; draw(); },
  };
}

function caption(bars, apart) {
  const found = html("figcaption", {}, html("span", {}, "1"), html("span", {}, apart ? `${apart} steps apart on average` : ""), html("span", {}, bars >= FEWEST ? `≥ ${bars}` : String(FEWEST)));
  found.style.maxWidth = `${Math.max(FEWEST, bars) * WIDEST}px`;
  return found;
}

function pair(name, value) {
  return value ? [html("dt", {}, name), html("dd", {}, value)] : [];
}
