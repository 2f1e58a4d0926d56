/* taciturn: encoding, checking and decoding of packets. Bytes are read and written one by one, so that neither
 * alignment nor byte order matters. */
#include <string.h>

#include "taciturn_parts.h"

enum { HEADER_SIZE = 32, CRC_SIZE = 4, TAG_SIZE = 16, BLOCK_SIZE = 64, LEAST_KEY = 16, MOST_KEY = 32 };
enum { VERSION = 1, AUTHENTICATED = 0x80, KINDS = 5, LINKS = 3 };
enum { AT_SEQUENCE = 0, AT_VERSION = 4, AT_KIND = 5, AT_LINK = 6, AT_ENCODING = 7, AT_LOOP = 8, AT_ENTRIES = 10 };
enum { AT_ZERO = 11, AT_EPOCH = 12, AT_TICK = 16, AT_FINGERPRINT = 24 };

#if TAC_FLOAT32
#define LARGEST_REAL FLT_MAX
#define ROUNDER 12582912.0f /* 1.5 * 2^23: adding and subtracting it rounds to the nearest integer, ties to even */
#else
#define LARGEST_REAL DBL_MAX
#define ROUNDER 6755399441055744.0 /* 1.5 * 2^52 */
#endif
#define LARGEST_STEP ((tac_real)32767)

/* The floating-point formats of the compiler must be those of the packets. */
typedef char tac_checks_float[(sizeof(float) == 4U && FLT_MANT_DIG == 24) ? 1 : -1];
typedef char tac_checks_double[(sizeof(double) == 8U && DBL_MANT_DIG == 53) ? 1 : -1];

static bool is_finite(tac_real value) {
  return value >= -LARGEST_REAL && value <= LARGEST_REAL;
}

void tac_put(uint8_t *to, uint64_t value, unsigned bytes) {
  for (unsigned i = 0U; i < bytes; i++) {
    unsigned shift = 8U * (bytes - 1U - i);
    to[i] = (uint8_t)((value >> shift) & 0xFFU);
  }
}

uint64_t tac_get(const uint8_t *from, unsigned bytes) {
  uint64_t value = 0U;
  for (unsigned i = 0U; i < bytes; i++) {
    value = (value << 8U) | from[i];
  }
  return value;
}

tac_word tac_bits(tac_real value) {
  tac_word bits;
  (void)memcpy(&bits, &value, sizeof bits);
  return bits;
}

/* CRC-32 with the polynomial 0x04C11DB7, least significant bit first, four bits at a time. */
uint32_t tac_checksum(uint32_t before, const uint8_t *content, size_t size) {
  static const uint32_t table[16] = {
      0x00000000U, 0x1DB71064U, 0x3B6E20C8U, 0x26D930ACU, 0x76DC4190U, 0x6B6B51F4U, 0x4DB26158U, 0x5005713CU,
      0xEDB88320U, 0xF00F9344U, 0xD6D6A3E8U, 0xCB61B38CU, 0x9B64C2B0U, 0x86D3D2D4U, 0xA00AE278U, 0xBDBDF21CU,
  };
  uint32_t remainder = before ^ 0xFFFFFFFFU;
  for (size_t i = 0U; i < size; i++) {
    remainder ^= content[i];
    remainder = (remainder >> 4U) ^ table[remainder & 15U];
    remainder = (remainder >> 4U) ^ table[remainder & 15U];
  }
  return remainder ^ 0xFFFFFFFFU;
}

static const uint32_t BLAKE_START[8] = {
    0x6A09E667U, 0xBB67AE85U, 0x3C6EF372U, 0xA54FF53AU, 0x510E527FU, 0x9B05688CU, 0x1F83D9ABU, 0x5BE0CD19U,
};

static uint32_t turned_right(uint32_t word, unsigned by) {
  return (word >> by) | (word << (32U - by));
}

/* Mix two words of the message into a column or a diagonal of the BLAKE2s state. */
static void mix(uint32_t *v, unsigned a, unsigned b, unsigned c, unsigned d, uint32_t x, uint32_t y) {
  v[a] += v[b] + x;
  v[d] = turned_right(v[d] ^ v[a], 16U);
  v[c] += v[d];
  v[b] = turned_right(v[b] ^ v[c], 12U);
  v[a] += v[b] + y;
  v[d] = turned_right(v[d] ^ v[a], 8U);
  v[c] += v[d];
  v[b] = turned_right(v[b] ^ v[c], 7U);
}

/* Add a block of the message to the BLAKE2s state; `bytes` is the length of the message up to the end of the block. */
static void compress(uint32_t *state, const uint8_t *block, uint64_t bytes, bool last) {
  static const uint8_t order[10][16] = {
      {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}, {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
      {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4}, {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
      {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13}, {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
      {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11}, {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
      {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5}, {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
  };
  uint32_t v[16];
  uint32_t words[16];
  for (unsigned i = 0U; i < 16U; i++) {
    const uint8_t *at = &block[4U * i]; /* little-endian, unlike the packet */
    words[i] = (uint32_t)at[0] | ((uint32_t)at[1] << 8U) | ((uint32_t)at[2] << 16U) | ((uint32_t)at[3] << 24U);
    v[i] = (i < 8U) ? state[i] : BLAKE_START[i - 8U];
  }
  v[12] ^= (uint32_t)(bytes & 0xFFFFFFFFU);
  v[13] ^= (uint32_t)(bytes >> 32U);
  v[14] ^= last ? 0xFFFFFFFFU : 0U;
  for (unsigned round = 0U; round < 10U; round++) {
    const uint8_t *next = order[round];
    for (unsigned i = 0U; i < 4U; i++) {
      mix(v, i, 4U + i, 8U + i, 12U + i, words[next[2U * i]], words[next[(2U * i) + 1U]]);
    }
    for (unsigned i = 0U; i < 4U; i++) {
      mix(v, i, 4U + ((i + 1U) & 3U), 8U + ((i + 2U) & 3U), 12U + ((i + 3U) & 3U), words[next[8U + (2U * i)]],
          words[next[9U + (2U * i)]]);
    }
  }
  for (unsigned i = 0U; i < 8U; i++) {
    state[i] ^= v[i] ^ v[8U + i];
  }
}

/* Write the tag of at least one byte of content: keyed BLAKE2s of 16 bytes with the personalization "taciturn". */
static void write_tag(tac_key key, const uint8_t *content, size_t size, uint8_t *tag) {
  uint32_t state[8];
  uint8_t block[BLOCK_SIZE] = {0};
  uint64_t bytes = BLOCK_SIZE;
  size_t done = 0U;
  (void)memcpy(state, BLAKE_START, sizeof state);
  state[0] ^= 0x01010000U ^ ((uint32_t)key.size << 8U) ^ (uint32_t)TAG_SIZE;
  state[6] ^= 0x69636174U; /* "taci" */
  state[7] ^= 0x6E727574U; /* "turn" */
  (void)memcpy(block, key.bytes, key.size);
  compress(state, block, bytes, false);
  for (; size - done > (size_t)BLOCK_SIZE; done += (size_t)BLOCK_SIZE) {
    bytes += (uint64_t)BLOCK_SIZE;
    compress(state, &content[done], bytes, false);
  }
  (void)memset(block, 0, sizeof block);
  (void)memcpy(block, &content[done], size - done);
  compress(state, block, bytes + (size - done), true);
  for (unsigned i = 0U; i < (unsigned)TAG_SIZE; i++) {
    tag[i] = (uint8_t)((state[i / 4U] >> (8U * (i % 4U))) & 0xFFU);
  }
}

static bool fits(tac_key key) {
  return key.size >= (uint8_t)LEAST_KEY && key.size <= (uint8_t)MOST_KEY;
}

/* Return whether a tag is correct, in constant time. */
static bool has_tag(tac_key key, const uint8_t *content, size_t size) {
  uint8_t tag[TAG_SIZE];
  uint8_t difference = 0U;
  if (!fits(key)) {
    return false;
  }
  write_tag(key, content, size, tag);
  for (unsigned i = 0U; i < (unsigned)TAG_SIZE; i++) {
    difference = (uint8_t)(difference | (tag[i] ^ content[size + i]));
  }
  return difference == 0U;
}

static const tac_shape *find_shape(const tac_wire *wire, uint8_t kind, uint8_t link) {
  for (unsigned i = 0U; i < wire->shape_count; i++) {
    if (wire->shapes[i].kind == kind && wire->shapes[i].link == link) {
      return &wire->shapes[i];
    }
  }
  return NULL;
}

static unsigned width(uint8_t encoding) {
  static const uint8_t widths[3] = {8U, 4U, 2U};
  return widths[encoding];
}

/* Write a number as float32. Return false if the number exceeds its range. */
static bool put_single(uint8_t *to, tac_real value) {
  float narrow = (float)value;
  uint32_t bits;
  (void)memcpy(&bits, &narrow, sizeof bits);
  tac_put(to, bits, 4U);
  return narrow >= -FLT_MAX && narrow <= FLT_MAX;
}

static void put_double(uint8_t *to, tac_real value) {
  double wide = (double)value;
  uint64_t bits;
  (void)memcpy(&bits, &wide, sizeof bits);
  tac_put(to, bits, 8U);
}

/* Write a number as the nearest integer multiple of the step size. */
static void put_steps(uint8_t *to, tac_real value, tac_real per_unit) {
  tac_real steps = value * per_unit;
  if (steps > LARGEST_STEP) {
    steps = LARGEST_STEP;
  }
  if (steps < -LARGEST_STEP) {
    steps = -LARGEST_STEP;
  }
  steps += ROUNDER;
  steps -= ROUNDER;
  tac_put(to, (uint16_t)(int32_t)steps, 2U);
}

/* Write an entry of a payload. Return false if the number cannot be represented. */
static bool put_entry(uint8_t *to, const tac_shape *shape, unsigned entry, tac_real value) {
  bool written = is_finite(value);
  if (!written) {
    return false;
  }
  if (shape->encoding == (uint8_t)TAC_ENCODED_INT16) {
    put_steps(to, value, shape->per_unit[entry]);
  } else if (shape->encoding == (uint8_t)TAC_ENCODED_FLOAT32) {
    written = put_single(to, value);
  } else {
    put_double(to, value);
  }
  return written;
}

/* Return an entry of a payload, which may be infinite or NaN. */
static tac_real get_entry(const uint8_t *from, const tac_shape *shape, unsigned entry) {
  if (shape->encoding == (uint8_t)TAC_ENCODED_INT16) {
    int32_t steps = (int32_t)tac_get(from, 2U);
    return (tac_real)((steps < 32768) ? steps : (steps - 65536)) * shape->per_step[entry];
  }
  if (shape->encoding == (uint8_t)TAC_ENCODED_FLOAT32) {
    uint32_t bits = (uint32_t)tac_get(from, 4U);
    float narrow;
    (void)memcpy(&narrow, &bits, sizeof narrow);
    return (tac_real)narrow;
  } else {
    uint64_t bits = tac_get(from, 8U);
    double wide;
    (void)memcpy(&wide, &bits, sizeof wide);
    return (tac_real)wide;
  }
}

static void put_header(const tac_wire *wire, uint8_t coded, const tac_packet *packet, uint8_t *datagram) {
  tac_put(&datagram[AT_SEQUENCE], packet->sequence, 4U);
  datagram[AT_VERSION] = (uint8_t)VERSION;
  datagram[AT_KIND] = packet->kind;
  datagram[AT_LINK] = packet->link;
  datagram[AT_ENCODING] = coded;
  tac_put(&datagram[AT_LOOP], packet->loop, 2U);
  datagram[AT_ENTRIES] = packet->entries;
  datagram[AT_ZERO] = 0U;
  tac_put(&datagram[AT_EPOCH], packet->epoch, 4U);
  tac_put(&datagram[AT_TICK], packet->tick, 8U);
  tac_put(&datagram[AT_FINGERPRINT], wire->fingerprint, 8U);
}

size_t tac_encode(const tac_wire *wire, tac_key key, const tac_packet *packet, uint8_t *datagram) {
  const tac_shape *shape = find_shape(wire, packet->kind, packet->link);
  size_t size = (size_t)HEADER_SIZE;
  uint8_t flag = (key.bytes == NULL) ? 0U : (uint8_t)AUTHENTICATED;
  if (shape == NULL || packet->entries != shape->entries || (key.bytes != NULL && !fits(key))) {
    return 0U;
  }
  put_header(wire, (uint8_t)(shape->encoding | flag), packet, datagram);
  for (unsigned i = 0U; i < shape->entries; i++) {
    if (!put_entry(&datagram[size], shape, i, packet->values[i])) {
      return 0U;
    }
    size += width(shape->encoding);
  }
  tac_put(&datagram[size], tac_checksum(0U, datagram, size), (unsigned)CRC_SIZE);
  size += (size_t)CRC_SIZE;
  if (key.bytes != NULL) {
    write_tag(key, datagram, size, &datagram[size]);
    size += (size_t)TAG_SIZE;
  }
  return size;
}

/* Check everything except the payload, which ends at `end`. */
static tac_verdict check(const tac_wire *wire, tac_key key, const uint8_t *datagram, size_t end) {
  bool authenticated = (datagram[AT_ENCODING] & (uint8_t)AUTHENTICATED) != 0U;
  if (datagram[AT_VERSION] != (uint8_t)VERSION || authenticated != (key.bytes != NULL)) {
    return TAC_FOREIGN;
  }
  if (tac_checksum(0U, datagram, end) != (uint32_t)tac_get(&datagram[end], (unsigned)CRC_SIZE)) {
    return TAC_CORRUPTED;
  }
  if (tac_get(&datagram[AT_FINGERPRINT], 8U) != wire->fingerprint) {
    return TAC_FOREIGN;
  }
  if (authenticated && !has_tag(key, datagram, end + (size_t)CRC_SIZE)) {
    return TAC_FORGED;
  }
  if (datagram[AT_KIND] >= (uint8_t)KINDS || datagram[AT_LINK] >= (uint8_t)LINKS || datagram[AT_ZERO] != 0U) {
    return TAC_MALFORMED;
  }
  return TAC_OK;
}

/* Read the payload of a packet. Return false if its format is wrong, or if a value is not finite. */
static bool read_values(const tac_shape *shape, const uint8_t *payload, tac_packet *packet) {
  for (unsigned i = 0U; i < shape->entries; i++) {
    packet->values[i] = get_entry(&payload[(size_t)i * width(shape->encoding)], shape, i);
    if (!is_finite(packet->values[i])) {
      return false;
    }
  }
  return true;
}

tac_verdict tac_decode(const tac_wire *wire, tac_key key, const uint8_t *datagram, size_t size, tac_packet *packet) {
  const tac_shape *shape;
  size_t around = (size_t)CRC_SIZE + ((key.bytes == NULL) ? 0U : (size_t)TAG_SIZE);
  size_t end = size - around;
  tac_verdict verdict;
  if (size < around + (size_t)HEADER_SIZE) {
    return TAC_MALFORMED;
  }
  verdict = check(wire, key, datagram, end);
  if (verdict != TAC_OK) {
    return verdict;
  }
  shape = find_shape(wire, datagram[AT_KIND], datagram[AT_LINK]);
  if (shape == NULL || (datagram[AT_ENCODING] & 0x7FU) != shape->encoding || datagram[AT_ENTRIES] != shape->entries ||
      end - (size_t)HEADER_SIZE != (size_t)shape->entries * width(shape->encoding)) {
    return TAC_MALFORMED;
  }
  packet->sequence = (uint32_t)tac_get(&datagram[AT_SEQUENCE], 4U);
  packet->kind = datagram[AT_KIND];
  packet->link = datagram[AT_LINK];
  packet->loop = (uint16_t)tac_get(&datagram[AT_LOOP], 2U);
  packet->entries = datagram[AT_ENTRIES];
  packet->epoch = (uint32_t)tac_get(&datagram[AT_EPOCH], 4U);
  packet->tick = tac_get(&datagram[AT_TICK], 8U);
  return read_values(shape, &datagram[HEADER_SIZE], packet) ? TAC_OK : TAC_MALFORMED;
}
