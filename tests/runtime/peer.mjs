// A node of a policy in plain JavaScript, written from docs/wire-format.md alone.
//
// The program plays one role in virtual time. It reads what `taciturn show FILE --wire` prints, so it knows no policy:
//
//     taciturn show two-mass --wire > two-mass.json
//     node peer.mjs two-mass.json actuator --bind :9103 --plant :9100 --steps 200
//
// The options are --bind, --peer, --plant and --key as for `taciturn node`. After --steps steps, or on SIGINT or
// SIGTERM, it prints its counters as one JSON line. It needs Node.js 20.15 or later, and no packages.

import { randomBytes } from "node:crypto";
import { createSocket } from "node:dgram";
import { lookup } from "node:dns/promises";
import { readFileSync } from "node:fs";
import { parseArgs } from "node:util";

import { ACKNOWLEDGEMENT, ANSWER, CHALLENGE, DATA, EITHER, INPUT, MARK, MEASUREMENT, NONCE, Wire } from "./wire.mjs";

const PLANT = 2; // link
const REPEAT_MS = 50, LINGER_MS = 600; // least between repetitions; and after the last step, if nobody asks again

/** Whether a packet was sent after another one of its kind and link. */
function later(one, other) {
  return one.epoch > other.epoch || (one.epoch === other.epoch && one.sequence > other.sequence);
}

/** The sequence numbers of one kind on one link that have arrived. */
class Window {
  newest = null;
  seen = new Set();

  constructor(width) {
    this.width = width;
  }

  /** "new", "duplicate" or "replayed". */
  check(packet) {
    if (this.newest && packet.epoch < this.newest.epoch) return "replayed";
    if (!this.newest || packet.epoch > this.newest.epoch) this.seen.clear();
    else if (packet.sequence < this.newest.sequence - this.width) return "replayed";
    else if (this.seen.has(packet.sequence)) return "duplicate";
    if (!this.newest || later(packet, this.newest)) this.newest = packet;
    this.seen.add(packet.sequence);
    this.seen.delete(this.newest.sequence - this.width - 1); // keeps the set small; older sequences are replays
    return "new";
  }
}

// ---- computations ---------------------------------------------------------------------------------------------------

const CONSTANTS = { inf: Infinity, "-inf": -Infinity, nan: NaN };
const parse = (c) => (typeof c === "number" ? c : CONSTANTS[c] ?? BigInt(c)); // a number, or the text of a word
const view = new DataView(new ArrayBuffer(8));
const word = (value) => BigInt.asUintN(64, value);

/** What each operation computes from its arguments, which are numbers of operations: v[a] is the result of a. */
const OPERATIONS = {
  const: (v, c) => parse(c),
  state: (v, i) => v.memory[i],
  input: (v, i) => v.inputs[i],
  add: (v, a, b) => v[a] + v[b],
  sub: (v, a, b) => v[a] - v[b],
  mul: (v, a, b) => v[a] * v[b],
  div: (v, a, b) => v[a] / v[b],
  sqrt: (v, a) => Math.sqrt(v[a]),
  greater: (v, a, b) => v[a] > v[b],
  less_equal: (v, a, b) => v[a] <= v[b],
  and: (v, a, b) => v[a] && v[b],
  not: (v, a) => !v[a],
  select: (v, a, b, c) => (v[a] ? v[b] : v[c]),
  lookup: (v, table, i) => table[v[i]],
  product: (v, rows, ...list) =>
    rows.map(({ column, coefficients }) => coefficients.reduce((sum, c, i) => sum + c * v[list[column + i]], 0)),
  entry: (v, a, i) => v[a][i],
  narrow: (v, a) => Math.fround(v[a]),
  word: (v, c) => parse(c),
  bits: (v, a) => (view.setFloat64(0, v[a]), view.getBigUint64(0)),
  number: (v, a) => (view.setBigUint64(0, v[a]), view.getFloat64(0)),
  word_add: (v, a, b) => word(v[a] + v[b]),
  word_and: (v, a, b) => v[a] & v[b],
  word_or: (v, a, b) => v[a] | v[b],
  word_xor: (v, a, b) => v[a] ^ v[b],
  shift_left: (v, a, n) => word(v[a] << BigInt(n)),
  shift_right: (v, a, n) => v[a] >> BigInt(n),
  rotate_left: (v, a, n) => word(v[a] << BigInt(n)) | (v[a] >> BigInt(64 - n)),
  any_bit: (v, a) => v[a] !== 0n,
  pick: (v, table, a) => table[Number(v[a] & 7n)],
};

/** Runs the operations of a part: the next memories and the results. */
function compute({ operations, next, results }, memory, inputs) {
  const values = Object.assign([], { memory, inputs });
  for (const operation of operations) values.push(operation && OPERATIONS[operation[0]](values, ...operation.slice(1)));
  return { memory: next.map((i) => values[i]), results: results.map((i) => values[i]) };
}

/** The computations of a node: in each step from a measurement and packets to the results. */
class Computation {
  constructor(node) {
    this.node = node;
    this.inputs = node.inputs.map(() => 0);
    this.memory = node.memory.map(({ start }) => parse(start));
    this.words = node.draws ? node.draws.memory.map(parse) : [];
    this.stepped = false; // whether a step has been executed
  }

  /** The results of one step; `read(part)` sets the inputs of the packets that this part reads. */
  step(measurement, read) {
    const { parts, counters, draws } = this.node, { inputs } = this;
    if (this.stepped && parts.length === 2) {
      read(1);
      this.run(parts[1]);
    }
    for (const { input, start, next } of counters) inputs[input] = this.stepped ? next[inputs[input]] : start;
    measurement.forEach((value, i) => {
      inputs[i] = Number.isNaN(value) ? 0 : value;
      inputs[measurement.length + i] = Number.isNaN(value) ? 0 : 1;
    });
    read(0);
    if (draws) {
      const drawn = compute(draws, this.words, []);
      this.words = drawn.memory;
      drawn.results.forEach((value, i) => (inputs[draws.input + i] = value));
    }
    this.stepped = true;
    return this.run(parts[0]);
  }

  run(part) {
    const { memory, results } = compute(part, this.memory, part.reads.map((i) => this.inputs[i]));
    this.memory = memory;
    return results;
  }
}

// ---- the node -------------------------------------------------------------------------------------------------------

/** One node in virtual time, without sockets: packets go in at `receive` and out at `send(packet)`. */
class Peer {
  tick = 0; // the next step
  began = false; // whether any packet has arrived
  last = [[], []]; // the packets of the last two steps
  repeated = new Map(); // when they were sent again, by link
  sessions = new Map(); // of each link: the proven epoch, its first valid step, and the nonce of the open challenge
  counters = {};

  /** With `keyed`, senders must prove that they are running; `challenge(packet, sender)` sends a challenge back. */
  constructor(description, role, ticks, send, keyed, challenge) {
    this.node = description.nodes.find((node) => node.role === role);
    if (!this.node) throw new Error(`the policy has no node ${role}`);
    const { links, steps_ahead: ahead, window: width } = description.wire;
    Object.assign(this, { keyed, challenge, ticks, send, links, ahead, width, lossless: description.lossless });
    this.computation = new Computation(this.node);
    this.sending = this.node.sends.map(({ link }) => link);
    for (const { link, acknowledge } of this.node.receives) if (acknowledge) this.sending.push(link);
    this.mailboxes = this.node.receives.map((entry) => ({ ...entry, early: new Map(), late: null, newest: null }));
    this.lags = new Map(); // of each link from which packets arrive: the smallest, since its mark is the latest
    for (const { link, lag } of this.node.receives) this.lags.set(link, Math.min(lag, this.lags.get(link) ?? lag));
    for (const name of ["marks", "measurements", "windows", "streams"]) this[name] = new Map();
    this.epoch = Math.floor(Date.now() / 1000);
    this.count = (name) => void (this.counters[name] = (this.counters[name] ?? 0) + 1);
  }

  /** Whether this node sends packets along a link; on all other links they travel against it. */
  along(link) {
    return this.node.sends.some((send) => send.link === link);
  }

  sends(link) {
    return this.sending.includes(link) || (link === PLANT && Boolean(this.node.applies));
  }

  /** Handles challenges, answers, and packets whose sender has not proven that it is running; returns whether so. */
  prove(packet, sender) {
    const { kind, link, epoch, tick, back, nonce } = packet;
    const strange = packet.loop !== 0 || (EITHER.includes(kind) && back !== this.along(link));
    if (strange || (kind === CHALLENGE && !this.sends(link))) return this.count("misdirected"), true;
    if (kind === CHALLENGE) {
      const first = Math.max(this.tick - 2, 0); // this.tick is the next step
      this.send({ kind: ANSWER, link, tick: first, sequence: 0, epoch: this.epoch, back: !back, nonce });
      this.repeat(link);
      return true;
    }
    const session = this.sessions.get(link) ?? {};
    this.sessions.set(link, session);
    if (kind === ANSWER) {
      if (session.nonce === undefined || session.nonce !== nonce) return true;
      const old = session.epoch === epoch ? [] : [...this.windows.keys()].filter((one) => one.endsWith(` ${link}`));
      old.forEach((one) => this.windows.delete(one));
      this.sessions.set(link, { epoch, first: tick });
      return true;
    }
    if (!this.keyed || (session.epoch === epoch && tick >= session.first)) return false;
    if (session.epoch === epoch) return this.count("replayed"), true;
    this.count("unproven");
    session.nonce ??= randomBytes(NONCE).readBigUInt64BE();
    const challenge = { kind: CHALLENGE, link, tick: 0, sequence: 0, epoch: 0, back: !back, nonce: session.nonce };
    this.challenge(challenge, sender);
    return true;
  }

  receive(packet, sender) {
    if (this.prove(packet, sender)) return;
    const { kind, link, tick } = packet, stream = `${kind} ${link}`;
    const mailbox = this.mailboxes.find((box) => box.kind === kind && box.link === link);
    const physical = kind === MEASUREMENT && this.node.measurement > 0;
    this.count(physical ? "physical" : "received");
    if (packet.loop !== 0 || !(physical || mailbox || (kind === MARK && this.lags.has(link))))
      return this.count("misdirected");
    if (!this.windows.has(stream)) this.windows.set(stream, new Window(this.width));
    const seen = this.windows.get(stream).check(packet);
    if (seen !== "new") {
      this.count(seen);
      if (seen === "duplicate" && (kind === MARK || kind === MEASUREMENT)) this.repeat();
      return;
    }
    if (tick > this.tick + this.ahead) return this.count("ahead");
    this.began = true;
    if (physical) this.measurements.set(tick, packet.values);
    else if (kind === MARK) {
      this.count("marks");
      this.marks.set(link, Math.max(tick, this.marks.get(link) ?? tick));
    } else if (tick < this.tick - mailbox.lag) {
      this.count("late");
      const newer = [mailbox.newest, mailbox.late].every((other) => !other || later(packet, other));
      if (this.lossless && newer) mailbox.late = packet;
    } else {
      const other = mailbox.early.get(tick);
      if (other) this.count("superseded");
      if (!other || later(packet, other)) mailbox.early.set(tick, packet);
    }
    while (this.tick < this.ticks && this.ready()) this.step();
  }

  ready() {
    if (!this.began || (this.node.measurement > 0 && !this.measurements.has(this.tick))) return false;
    return [...this.lags].every(([link, lag]) => this.tick < lag || (this.marks.get(link) ?? -1) >= this.tick - lag);
  }

  step() {
    const { node, tick, computation } = this, read = [];
    const results = computation.step(this.measurements.get(tick) ?? [], (part) => {
      for (const box of this.mailboxes.filter((one) => one.part === part)) {
        const packet = this.take(box);
        const values = packet ? [1, ...packet.values] : new Array(1 + box.entries).fill(0);
        values.forEach((value, i) => (computation.inputs[box.input + i] = value));
        if (packet && box.acknowledge) read.push(packet);
      }
    });
    this.measurements.delete(tick);
    this.last = [this.last[1], []];
    for (const { link, output, entries } of node.sends)
      if (results[output]) this.post(DATA, link, tick, results.slice(output + 1, output + 1 + entries));
    for (const packet of read) this.post(ACKNOWLEDGEMENT, packet.link, packet.tick);
    for (const link of this.sending) this.post(MARK, link, tick);
    for (const { output, entries } of node.applies ? [node.applies] : [])
      this.post(INPUT, PLANT, tick, results.slice(output, output + entries));
    this.tick += 1;
  }

  /** The packet that this step reads from a mailbox: the one of its step, or a newer one that came too late. */
  take(box) {
    const { late, early } = box, tick = this.tick - box.lag;
    let packet = early.get(tick);
    early.delete(tick);
    box.late = null;
    if (packet) this.count("used");
    if (late && (!packet || later(late, packet))) packet = late;
    if (packet && (!box.newest || later(packet, box.newest))) box.newest = packet;
    return packet;
  }

  post(kind, link, tick, values = []) {
    const stream = `${kind} ${link}`;
    const { sequence: sent, epoch } = this.streams.get(stream) ?? { sequence: -1, epoch: this.epoch };
    const next = sent < 2 ** 32 - 1 ? { sequence: sent + 1, epoch } : { sequence: 0, epoch: epoch + 1 };
    this.streams.set(stream, next); // an input of step k has sequence k too, since a node has one input in each step
    const packet = { kind, link, tick, ...next, values, back: kind === MARK && !this.along(link) };
    if (kind !== INPUT) this.count(`sent ${["data", "acknowledgement", "mark"][kind]} ${this.links[link]}`);
    this.last[1].push(packet);
    this.send(packet);
  }

  /** Sends the packets of the last two steps again: those of one link, or of all links. */
  repeat(link = null) {
    const packets = this.last.flat().filter((packet) => link === null || packet.link === link);
    if (performance.now() < (this.repeated.get(link) ?? -Infinity) + REPEAT_MS || packets.length === 0) return;
    this.repeated.set(link, performance.now());
    this.count("repeated");
    packets.forEach((packet) => this.send(packet));
  }
}

// ---- sockets --------------------------------------------------------------------------------------------------------

async function address(text) {
  const [, host, port] = /^(.*):(\d+)$/.exec(text);
  return { host: (await lookup(host || "127.0.0.1", 4)).address, port: Number(port) };
}

async function main() {
  const text = { type: "string" };
  const { values: options, positionals: [file, role] } = parseArgs({
    allowPositionals: true, options: { bind: text, peer: text, plant: text, steps: text, key: text },
  });
  const description = JSON.parse(readFileSync(file, "utf8"));
  const key = options.key ? Buffer.from(readFileSync(options.key, "utf8").trim(), "hex") : null;
  const own = await address(options.bind ?? ":0");
  const others = {};
  for (const name of ["peer", "plant"]) others[name] = options[name] && (await address(options[name]));
  const ticks = Number(options.steps ?? Infinity);
  const wire = new Wire(description, key);
  const socket = createSocket("udp4"), datagrams = { sent: 0, received: 0 }, refused = {};
  let ending;

  const send = (packet, { host, port }) => {
    datagrams.sent += 1;
    socket.send(wire.encode(packet), port, host);
  };
  const usual = (packet) => send(packet, others[packet.link === PLANT ? "plant" : "peer"]);
  const peer = new Peer(description, role, ticks, usual, key !== null, send);

  function end() {
    socket.close();
    console.log(JSON.stringify({ role, tick: peer.tick - 1, counters: peer.counters, refused, datagrams }));
    process.exit();
  }

  socket.on("message", (datagram, { address: host, port }) => {
    datagrams.received += 1;
    const packet = wire.decode(datagram);
    if (typeof packet === "string") refused[packet] = (refused[packet] ?? 0) + 1;
    else peer.receive(packet, { host, port });
    if (peer.tick < ticks) return;
    clearTimeout(ending);
    ending = setTimeout(end, LINGER_MS);
  });
  socket.bind(own.port, own.host, () => console.error(`listens on ${own.host}:${socket.address().port}`));
  for (const signal of ["SIGINT", "SIGTERM"]) process.on(signal, end);
}

await main();
