// Curves over time: one uPlot chart per panel, with a legend that shows values, and colours from the style sheet.

export function color(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

export function format(value) {
  if (value === null || value === undefined) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e-3 || size >= 1e5) return value.toExponential(2).replace(/\.?0+e/, "e");
  return String(Number(value.toPrecision(4)));
}

// Create a legend whose entries also differ in line style, and return its elements for the values.
export function legend(panel, series) {
  const host = panel.querySelector(".legend");
  host.replaceChildren();
  return series.map((one) => {
    const entry = document.createElement("span");
    const swatch = document.createElement("span");
    swatch.className = `swatch ${one.look}`;
    swatch.style.color = `var(--${one.color})`;
    const value = document.createElement("span");
    entry.append(swatch, one.name, " ", value);
    host.append(entry);
    return value;
  });
}

const DASHES = { dashed: [7, 4], dotted: [2, 3] };
const FONT = "11px system-ui, sans-serif";

// Return the range from the first to the last time, or a range of 1 s if there is only one time.
function span({ data: [times] }) {
  const [first, last] = [times[0] ?? 0, times.at(-1) ?? 0];
  return [first, last > first ? last : first + 1];
}

function range(lower, upper, include) {
  return (plot, least, most) => {
    const known = [least, most, ...include].filter((value) => value !== null && Number.isFinite(value));
    if (known.length === 0) return [0, 1];
    let low = Math.min(...known), high = Math.max(...known);
    const room = high > low ? 0.06 * (high - low) : Math.max(0.1 * Math.abs(high), 1e-6);
    return [lower ?? low - room, upper ?? high + room];
  };
}

// Return whether curves need a log scale (values >= 0 that span more than two decades), and their values on the chosen
// scale. Zeros are shown below all other values.
export function scaled(values) {
  const known = values.flat().filter((value) => value !== null);
  let least = Infinity, most = 0;
  for (const value of known) {
    if (value < 0) return [false, values];
    if (value > 0) least = Math.min(least, value);
    most = Math.max(most, value);
  }
  if (!(most > 100 * least)) return [false, values];
  const floor = 10 ** Math.floor(Math.log10(Math.max(least, most * 1e-8)) - 0.3);
  return [true, values.map((list) => list.map((value) => value === null ? null : Math.max(value, floor)))];
}

// Return the powers of ten on a log scale, limited to the number of labels that fit.
function decades(plot, axis, least, most) {
  const low = Math.ceil(Math.log10(least) - 1e-9), high = Math.floor(Math.log10(most) + 1e-9), found = [];
  const stride = Math.max(1, Math.ceil((high - low + 1) * 20 / plot.bbox.height * devicePixelRatio));
  for (let k = high; k >= low; k -= stride) found.unshift(Number(`1e${k}`));
  return found;
}

// series: [{name, color, look: "solid" | "dashed" | "dotted" | "thin" | "disc" | "ring", steps}]
export class Curves {
  constructor(panel, series, { lower, upper, include = [], log = false } = {}) {
    this.panel = panel;
    this.series = series;
    this.log = log;
    this.values = legend(panel, series);
    this.host = panel.querySelector(".plot");
    const axis = {
      stroke: () => color("dim"), font: FONT, gap: 3,
      grid: { stroke: () => color("line"), width: 1 }, ticks: { stroke: () => color("line"), width: 1, size: 4 },
    };
    const width = (plot, labels) => 14 + 6.5 * Math.max(3, ...(labels ?? []).map((label) => label.length));
    const ticks = (plot, splits) => splits.map((value) => (value === null ? "" : format(value)));
    this.plot = new uPlot({
      width: this.host.clientWidth, height: this.host.clientHeight, padding: [8, 18, 0, 0],
      scales: {
        x: { time: false, range: span },
        y: log ? { distr: 3, range: (plot, least, most) => [least ?? 0.1, (most ?? 1) * 1.6] }
          : { range: range(lower, upper, include) },
      },
      axes: [
        { ...axis, size: 22, values: ticks },
        { ...axis, size: width, values: ticks, space: 26, ...(log && { splits: decades, filter: (_, all) => all }) },
      ],
      series: [{}, ...series.map((one) => this.line(one))],
      legend: { show: false },
      cursor: { y: false, drag: { x: false, y: false }, sync: { key: "time" }, points: { size: 6 } },
      hooks: { setCursor: [() => this.tell()] },
    }, [[], ...series.map(() => [])], this.host);
    this.watch = new ResizeObserver(() => {
      this.plot.setSize({ width: this.host.clientWidth, height: this.host.clientHeight });
    });
    this.watch.observe(this.host);
  }

  line({ color: name, look, steps }) {
    const stroke = () => color(name);
    if (look === "disc" || look === "ring") {
      const fill = look === "disc" ? stroke : () => color("panel");
      const points = { show: true, size: look === "disc" ? 6 : 9, width: 1.5, stroke, fill };
      return { stroke, paths: () => null, points };
    }
    return {
      stroke, width: look === "thin" ? 1 : 1.6, dash: DASHES[look],
      points: { show: (plot) => plot.data[0].length < 3, size: 5 }, // show points if there are too few steps for a line
      paths: steps ? uPlot.paths.stepped({ align: 1 }) : undefined,
    };
  }

  // data: [times, values of each series, ...], with null for a missing value
  set(data) {
    this.data = data;
    this.plot.setData(data);
    this.tell();
  }

  // Show the values at the cursor, or the latest values.
  tell() {
    if (!this.data) return;
    const at = this.plot?.cursor.idx ?? this.data[0].length - 1;
    this.series.forEach((one, i) => {
      const dot = one.look === "disc" || one.look === "ring";
      this.values[i].textContent = dot ? "" : format(this.data[i + 1][at]);
    });
  }

  redraw() {
    this.plot.redraw(false);
  }

  close() {
    this.watch.disconnect();
    this.plot.destroy();
  }
}
