// Packets as docs/wire-format.md specifies them: encoding, decoding, checksum and tag.

import { timingSafeEqual } from "node:crypto";
import { crc32 } from "node:zlib";

export const DATA = 0, ACKNOWLEDGEMENT = 1, MARK = 2, MEASUREMENT = 3, INPUT = 4; // kinds
export const CHALLENGE = 5, ANSWER = 6, EITHER = [MARK, CHALLENGE, ANSWER]; // kinds; and those of both directions
export const NONCE = 8; // bytes
const BACK = [ACKNOWLEDGEMENT, INPUT]; // kinds that travel against their link
const VERSION = 2, BYTES = 3;
const HEADER = 32, CRC = 4, TAG = 16, TAGGED = 128;
const LARGEST = (2 - 2 ** -23) * 2 ** 127; // number that every encoding carries
const ENTRIES = [[8, "DoubleBE"], [4, "FloatBE"], [2, "Int16BE"]]; // bytes of an entry, and its name in Node.js

// ---- tag ------------------------------------------------------------------------------------------------------------

const BLAKE_START = Uint32Array.of(
  0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19);
const BLAKE_ORDERS = [
  "0123456789abcdef", "ea489fd61c02b753", "b8c052fdae367194", "7931dcbe265a40f8", "905724afe1bc683d",
  "2c6a0b834d75fe19", "c51fed4a0763928b", "db7ec13950f4862a", "6fe9b308c2d714a5", "a2847615fb9e3cd0",
].map((order) => [...order].map((digit) => parseInt(digit, 16)));
const BLAKE_MIXES = [[0, 4, 8, 12], [1, 5, 9, 13], [2, 6, 10, 14], [3, 7, 11, 15],
  [0, 5, 10, 15], [1, 6, 11, 12], [2, 7, 8, 13], [3, 4, 9, 14]];

/** Keyed BLAKE2s (RFC 7693) with a digest of 16 bytes and a person of 8 bytes, which node:crypto does not offer. */
function blake2s(bytes, key, person) {
  const parameters = Buffer.alloc(32);
  parameters.set([TAG, key.length, 1, 1]);
  parameters.write(person, 24, "latin1");
  const state = BLAKE_START.map((word, i) => word ^ parameters.readUInt32LE(4 * i));
  const padded = Buffer.alloc(64 * (1 + Math.ceil(bytes.length / 64)));
  padded.set(key, 0);
  padded.set(bytes, 64);
  const rotate = (word, bits) => (word >>> bits) | (word << (32 - bits));
  for (let start = 0; start < padded.length; start += 64) {
    const last = start + 64 === padded.length, v = Uint32Array.of(...state, ...BLAKE_START);
    v[12] ^= last ? 64 + bytes.length : start + 64;
    if (last) v[14] = ~v[14];
    for (const order of BLAKE_ORDERS) {
      BLAKE_MIXES.forEach(([a, b, c, d], i) => {
        for (const [half, first, second] of [[0, 16, 12], [1, 8, 7]]) {
          v[a] += v[b] + padded.readUInt32LE(start + 4 * order[2 * i + half]);
          v[d] = rotate(v[d] ^ v[a], first);
          v[c] += v[d];
          v[b] = rotate(v[b] ^ v[c], second);
        }
      });
    }
    state.forEach((word, i) => (state[i] = word ^ v[i] ^ v[i + 8]));
  }
  const digest = Buffer.alloc(32);
  state.forEach((word, i) => digest.writeUInt32LE(word, 4 * i));
  return digest.subarray(0, TAG);
}

// ---- packets --------------------------------------------------------------------------------------------------------

/** Encodes and decodes the datagrams of one policy. */
export class Wire {
  constructor(description, key) {
    this.key = key;
    this.person = description.wire.tag_person;
    this.fingerprint = BigInt("0x" + description.fingerprint);
    this.shapes = new Map(description.packets.map((packet) => [`${packet.kind} ${packet.link}`, packet]));
  }

  encode({ kind, link, tick, sequence, epoch, values = [], back = false, nonce = 0n }) {
    const proof = kind === CHALLENGE || kind === ANSWER;
    const { encoding, ranges } = proof ? { encoding: BYTES } : this.shapes.get(`${kind} ${link}`);
    const [bytes, name] = proof ? [NONCE, "BigUInt64BE"] : ENTRIES[encoding];
    const body = Buffer.alloc(HEADER + (proof ? NONCE : values.length * bytes));
    body.writeUInt32BE(sequence, 0);
    const direction = back || BACK.includes(kind) ? 1 : 0;
    body.set([VERSION, kind, link, encoding | (this.key ? TAGGED : 0), 0, 0, values.length, direction], 4);
    if (proof) body.writeBigUInt64BE(nonce, HEADER);
    body.writeUInt32BE(epoch, 12);
    body.writeBigUInt64BE(BigInt(tick), 16);
    body.writeBigUInt64BE(this.fingerprint, 24);
    values.forEach((value, i) => {
      body[`write${name}`](encoding === 2 ? toInteger((32767 * value) / ranges[i]) : value, HEADER + bytes * i);
    });
    const crc = Buffer.alloc(CRC);
    crc.writeUInt32BE(crc32(body));
    const summed = Buffer.concat([body, crc]);
    return this.key ? Buffer.concat([summed, blake2s(summed, this.key, this.person)]) : summed;
  }

  /** The packet of a datagram, or the name under which it is refused; the checks are in the order of the page. */
  decode(datagram) {
    const end = datagram.length - CRC - (this.key ? TAG : 0);
    if (end < HEADER) return "malformed";
    if (datagram[4] !== VERSION || datagram[7] >= TAGGED !== Boolean(this.key)) return "foreign";
    if (datagram.readUInt32BE(end) !== crc32(datagram.subarray(0, end))) return "corrupted";
    if (datagram.readBigUInt64BE(24) !== this.fingerprint) return "foreign";
    if (this.key) {
      const tag = blake2s(datagram.subarray(0, end + CRC), this.key, this.person);
      if (!timingSafeEqual(tag, datagram.subarray(end + CRC))) return "forged";
    }
    const [kind, link, encoding, entries] = [datagram[5], datagram[6], datagram[7] & 127, datagram[10]];
    const back = datagram[11] === 1;
    if (datagram[11] > 1 || (!EITHER.includes(kind) && back !== BACK.includes(kind))) return "malformed";
    const header = {
      kind, link, values: [], loop: datagram.readUInt16BE(8), sequence: datagram.readUInt32BE(0),
      epoch: datagram.readUInt32BE(12), tick: Number(datagram.readBigUInt64BE(16)), back,
    };
    if (kind === CHALLENGE || kind === ANSWER) {
      const valid = encoding === BYTES && entries === 0 && end === HEADER + NONCE && this.shapes.has(`${MARK} ${link}`);
      return valid ? { ...header, nonce: datagram.readBigUInt64BE(HEADER) } : "malformed";
    }
    const shape = this.shapes.get(`${kind} ${link}`);
    if (!shape || shape.encoding !== encoding || shape.entries !== entries) return "malformed";
    const [bytes, name] = ENTRIES[encoding];
    if (end !== HEADER + entries * bytes) return "malformed";
    const scale = (i) => (encoding === 2 ? shape.ranges[i] / 32767 : 1);
    const values = Array.from({ length: entries }, (_, i) => datagram[`read${name}`](HEADER + bytes * i) * scale(i));
    const carried = (value) => Math.abs(value) <= LARGEST || (shape.samples && Number.isNaN(value));
    if (!values.every(carried)) return "malformed";
    return { ...header, values };
  }
}

/** The nearest integer, ties to even, clipped to ±32767. */
function toInteger(x) {
  const below = Math.floor(x), up = x - below > 0.5 || (x - below === 0.5 && below % 2 !== 0);
  return Math.max(-32767, Math.min(32767, up ? below + 1 : below));
}
