// Drawings other than curves over time: the path in the plane, and the raster of packets.

import { color, format } from "./curves.js";

// A canvas that fills a panel and is drawn in CSS pixels.
export class Drawing {
  constructor(panel, draw) {
    this.host = panel.querySelector(".plot");
    this.canvas = document.createElement("canvas");
    this.host.append(this.canvas);
    this.draw = draw;
    this.watch = new ResizeObserver(() => this.redraw());
    this.watch.observe(this.host);
  }

  set(round) {
    this.round = round;
    this.redraw();
  }

  redraw() {
    const { clientWidth: width, clientHeight: height } = this.host;
    if (!this.round || width < 20 || height < 20) return;
    const scale = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(width * scale);
    this.canvas.height = Math.round(height * scale);
    const pen = this.canvas.getContext("2d");
    pen.scale(scale, scale);
    pen.font = "11px system-ui, sans-serif";
    this.draw(pen, width, height, this.round);
  }

  close() {
    this.watch.disconnect();
    this.canvas.remove();
  }
}

function stepOf(span, count) {
  const raw = span / Math.max(count, 1), power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= raw);
}

function extent(lists, i) {
  let low = Infinity, high = -Infinity;
  for (const points of lists) for (const point of points) {
    if (point === null) continue;
    low = Math.min(low, point[i]);
    high = Math.max(high, point[i]);
  }
  return low <= high ? [low, high] : [-1, 1];
}

// Draw the second state over the first state, with equal scales.
export function drawPlane(pen, width, height, { about, rows, others }) {
  const truth = rows.map((row) => row.state), estimate = rows.map((row) => row.estimate);
  const other = others.slice(0, rows.length).map((row) => row.state);
  const [left, bottom, room] = [46, 32, 10];
  const ranges = [0, 1].map((i) => extent([truth, estimate, other, about.reference], i));
  const [wide, high] = [width - left - room, height - bottom - room];
  const unit = 1.08 * Math.max((ranges[0][1] - ranges[0][0]) / wide, (ranges[1][1] - ranges[1][0]) / high, 1e-6);
  const middle = ranges.map(([low, high]) => (low + high) / 2);
  const across = (x) => left + wide / 2 + (x - middle[0]) / unit;
  const up = (y) => room + high / 2 - (y - middle[1]) / unit;

  pen.lineWidth = 1;
  pen.strokeStyle = color("line");
  pen.fillStyle = color("dim");
  const step = stepOf(Math.min(wide, high) * unit, 5);
  const grid = (low, most, draw) => {
    for (let k = Math.ceil(low / step); k * step <= most; k++) {
      draw(k * step, format(Number((k * step).toPrecision(6))));
    }
  };
  const span = [wide / 2 * unit, high / 2 * unit];
  pen.textAlign = "center";
  grid(middle[0] - span[0], middle[0] + span[0], (x, label) => {
    stroke(pen, [[across(x), room], [across(x), height - bottom]]);
    pen.fillText(label, across(x), height - bottom + 13);
  });
  pen.textAlign = "right";
  grid(middle[1] - span[1], middle[1] + span[1], (y, label) => {
    stroke(pen, [[left, up(y)], [width - room, up(y)]]);
    pen.fillText(label, left - 5, up(y) + 4);
  });
  pen.fillText(about.states[0], width - room, height - 5);
  pen.textAlign = "left";
  pen.fillText(about.states[1], left + 4, room + 9);

  const line = (points, name, dash, weight) => {
    pen.strokeStyle = color(name);
    pen.lineWidth = weight;
    pen.setLineDash(dash);
    stroke(pen, points.map((point) => point && [across(point[0]), up(point[1])]));
    pen.setLineDash([]);
  };
  line(about.reference, "reference", [2, 3], 2);
  line(other, "other", [], 1);
  line(truth, "true", [], 1.8);
  line(estimate, "estimate", [6, 4], 1.5);
  about.links.forEach((link, i) => {
    // marks at every step would hide the path
    if (rows.length > 20 && rows.every((row) => row.sent[link])) return;
    for (const row of rows) if (row.sent[link]) dot(pen, across(row.state[0]), up(row.state[1]), i);
  });
  const last = truth.at(-1);
  if (last) {
    pen.strokeStyle = color("ink");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(across(last[0]), up(last[1]), 8, 0, 2 * Math.PI);
    pen.stroke();
  }
}

function stroke(pen, points) {
  pen.beginPath();
  let down = false;
  for (const point of points) {
    if (point) (down ? pen.lineTo : pen.moveTo).call(pen, point[0], point[1]);
    down = Boolean(point);
  }
  pen.stroke();
}

// Draw a packet of the first link as a ring, and a packet of other links as a disc.
function dot(pen, x, y, i) {
  pen.beginPath();
  pen.arc(x, y, i === 0 ? 4.5 : 2.8, 0, 2 * Math.PI);
  pen.strokeStyle = pen.fillStyle = color(i === 0 ? "third" : "ink");
  pen.lineWidth = 1.3;
  if (i === 0) pen.stroke();
  else pen.fill();
}

// Draw one row per link and one column per step, for the latest steps that fit.
export function drawRaster(pen, width, height, { about, rows }) {
  const left = 62, bottom = 18, pitch = 9, top = 10;
  const shown = rows.slice(-Math.max(1, Math.floor((width - left - 6) / pitch)));
  const tall = Math.min((height - bottom - top) / about.links.length, 54);
  const column = (i) => left + i * pitch + pitch / 2;
  pen.textAlign = "left";
  about.links.forEach((link, j) => {
    const base = top + (j + 1) * tall - 5, size = tall - 12;
    pen.fillStyle = color("dim");
    pen.fillText(link, 2, base - size / 2 + 4);
    pen.strokeStyle = color("line");
    pen.lineWidth = 1;
    stroke(pen, [[left, base + 3], [width - 4, base + 3]]);
    shown.forEach((row, i) => {
      if (row.sent[link] && row.arrived[link]) {
        pen.fillStyle = color("true");
        pen.fillRect(column(i) - 2.5, base - size, 5, size);
      } else if (row.sent[link]) {
        pen.strokeStyle = color("lost");
        pen.lineWidth = 2;
        const y = base - size / 2;
        stroke(pen, [[column(i) - 3.5, y - 5], [column(i) + 3.5, y + 5]]);
        stroke(pen, [[column(i) - 3.5, y + 5], [column(i) + 3.5, y - 5]]);
      } else {
        pen.fillStyle = color("reference");
        pen.fillRect(column(i) - 1, base - 2, 2, 2);
      }
    });
  });
  pen.fillStyle = color("estimate");
  shown.forEach((row, i) => row.degraded && pen.fillRect(left + i * pitch, 2, pitch, 3));
  pen.fillStyle = color("dim");
  pen.textAlign = "center";
  const foot = top + about.links.length * tall + 10;
  shown.forEach((row, i) => row.tick % 10 === 0 && pen.fillText(String(row.tick), column(i), foot));
}
