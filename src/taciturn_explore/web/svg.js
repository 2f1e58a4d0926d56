// Elements of SVG and HTML, scales, ticks and paths.

const SPACE = "http://www.w3.org/2000/svg";

export function svg(name, attributes = {}, ...children) {
  const found = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) if (value !== null && value !== undefined) found.setAttribute(key, value);
  found.append(...children);
  return found;
}

export function html(name, attributes = {}, ...children) {
  const found = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) found.addEventListener(key.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) found.setAttribute(key, value === true ? "" : value);
  }
  found.append(...children.filter((child) => child !== null && child !== undefined));
  return found;
}

// A linear scale from a domain to pixels.
export function scale([low, high], [from, to]) {
  const span = high - low || 1;
  const map = (value) => from + ((value - low) / span) * (to - from);
  map.inverse = (pixel) => low + ((pixel - from) / (to - from || 1)) * span;
  map.domain = [low, high];
  return map;
}

// Round values of a step 1, 2 or 5 times a power of ten that divide a domain into about `many` parts.
export function ticks([low, high], many) {
  const rough = (high - low) / Math.max(1, many);
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= rough * 0.999);
  const found = [];
  for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + 1e-9 * step; value += step) found.push(Number(value.toPrecision(12)));
  return found;
}

export function number(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(Math.max(0, digits - 2)).replace(/\.?0+e/, "e").replace("-", "−");
  return String(Number(value.toPrecision(digits))).replace("-", "−");
}

// A line through points; a point that is not a number interrupts it.
export function line(points) {
  return path(points, (x, y) => `L${x} ${y}`);
}

// A held value, which changes at each point.
export function steps(points) {
  return path(points, (x, y) => `H${x}V${y}`);
}

function path(points, next) {
  let text = "", goes = false;
  for (const [x, y] of points) {
    if (Number.isFinite(y)) text += goes ? next(x.toFixed(1), y.toFixed(1)) : `M${x.toFixed(1)} ${y.toFixed(1)}`;
    goes = Number.isFinite(y);
  }
  return text;
}

// Return a number of things, such as "1 packet" or "2 packets".
export function amount(many, noun) {
  return `${many} ${noun}${many === 1 ? "" : "s"}`;
}

// Return whether two values of JSON are equal.
export function same(one, other) {
  return JSON.stringify(one) === JSON.stringify(other);
}

// Return the element with the focus in the document or shadow tree of a node.
export function active(node) {
  return node.getRootNode().activeElement;
}

export function once(frame) {
  let waiting = false;
  return () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      frame();
    });
  };
}

// A sentence whose numbers stand out.
export function emphasised(text) {
  return text.split(/([−-]?\d+(?:[.,]\d+)*(?:e[+-]?\d+)?(?:\s%)?)/).map((part, i) => i % 2 ? html("b", {}, part) : part);
}
