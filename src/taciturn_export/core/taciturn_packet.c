/* taciturn: encoding, checking and decoding of packets. Bytes are read and written one by one, so that neither
 * alignment nor byte order matters. */
#include <string.h>

#include "taciturn_parts.h"

enum { HEADER_SIZE = 32, CRC_SIZE = 4, TAG_SIZE = 16, LEAST_KEY = 16, MOST_KEY = 32 };
enum { VERSION = 2, AUTHENTICATED = 0x80, KINDS = (int)TAC_MODE + 1, ENCODED_BYTES = 3, NONCE_SIZE = 8 };
enum { AT_SEQUENCE = 0, AT_VERSION = 4, AT_KIND = 5, AT_LINK = 6, AT_ENCODING = 7, AT_LOOP = 8, AT_ENTRIES = 10 };
enum { AT_DIRECTION = 11, AT_EPOCH = 12, AT_TICK = 16, AT_FINGERPRINT = 24 };
enum { ANY_LINK = 255, ANY_POLICY = 0 }; /* in the challenge of an operator, who learns them from the answer */

#if TAC_FLOAT32
#define ROUNDER 12582912.0f /* 1.5 * 2^23: adding and subtracting it rounds to the nearest integer, ties to even */
#else
#define ROUNDER 6755399441055744.0 /* 1.5 * 2^52 */
#endif
#define LARGEST_STEP ((tac_real)32767)

/* The floating-point formats of the compiler must be those of the packets. */
typedef char tac_checks_float[(sizeof(float) == 4U && FLT_MANT_DIG == 24) ? 1 : -1];
typedef char tac_checks_double[(sizeof(double) == 8U && DBL_MANT_DIG == 53) ? 1 : -1];

bool tac_fits(const tac_real *numbers, unsigned count) {
  const tac_real most = (tac_real)FLT_MAX;
  bool found = true;
  for (unsigned i = 0U; found && i < count; i++) {
    found = (numbers[i] >= -most) && (numbers[i] <= most);
  }
  return found;
}

bool tac_is_nan(tac_real value) {
  return (tac_word)(tac_bits(value) << 1U) > (tac_word)(TAC_EXPONENT << 1U);
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
  tac_write_tag(key, content, size, tag);
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

/* Return whether a payload carries a number. */
static bool is_carried(const tac_shape *shape, const tac_real *value) {
  return tac_fits(value, 1U) || (shape->samples && tac_is_nan(*value));
}

/* Write an entry of a payload. Return false if the number cannot be represented. */
static bool put_entry(uint8_t *to, const tac_shape *shape, unsigned entry, tac_real value) {
  bool written = is_carried(shape, &value);
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

static bool is_proof(uint8_t kind) {
  return kind == (uint8_t)TAC_CHALLENGE || kind == (uint8_t)TAC_ANSWER;
}

/* Return whether nodes at both ends of a link send packets of a kind. */
static bool has_both(uint8_t kind) {
  return kind == (uint8_t)TAC_MARK || is_proof(kind);
}

/* Return whether packets of a kind that only one end sends travel against the link. */
static bool is_backward(uint8_t kind) {
  return kind == (uint8_t)TAC_ACKNOWLEDGEMENT || kind == (uint8_t)TAC_INPUT || kind == (uint8_t)TAC_REPORT ||
         kind == (uint8_t)TAC_MODE;
}

/* Return the link on which an operator gives set-points, or ANY_LINK if there is none. */
static uint8_t find_operator(const tac_wire *wire) {
  for (unsigned i = 0U; i < wire->shape_count; i++) {
    if (wire->shapes[i].kind == (uint8_t)TAC_SETPOINT) {
      return wire->shapes[i].link;
    }
  }
  return (uint8_t)ANY_LINK;
}

/* Return whether an operator, who does not know the policy, sends a challenge. */
static bool asks(const tac_wire *wire, const uint8_t *datagram) {
  return datagram[AT_KIND] == (uint8_t)TAC_CHALLENGE && datagram[AT_LINK] == (uint8_t)ANY_LINK &&
         datagram[AT_DIRECTION] == 0U && tac_get(&datagram[AT_FINGERPRINT], 8U) == (uint64_t)ANY_POLICY &&
         find_operator(wire) != (uint8_t)ANY_LINK;
}

static void put_header(const tac_wire *wire, uint8_t coded, const tac_packet *packet, uint8_t *datagram) {
  tac_put(&datagram[AT_SEQUENCE], packet->sequence, 4U);
  datagram[AT_VERSION] = (uint8_t)VERSION;
  datagram[AT_KIND] = packet->kind;
  datagram[AT_LINK] = packet->link;
  datagram[AT_ENCODING] = coded;
  tac_put(&datagram[AT_LOOP], packet->loop, 2U);
  datagram[AT_ENTRIES] = packet->entries;
  datagram[AT_DIRECTION] = (has_both(packet->kind) ? packet->back : is_backward(packet->kind)) ? 1U : 0U;
  tac_put(&datagram[AT_EPOCH], packet->epoch, 4U);
  tac_put(&datagram[AT_TICK], packet->tick, 8U);
  tac_put(&datagram[AT_FINGERPRINT], wire->fingerprint, 8U);
}

/* Write header and payload, and return their size, or 0 if the policy has no such packet or a value does not fit. */
static size_t put_content(const tac_wire *wire, uint8_t flag, const tac_packet *packet, uint8_t *datagram) {
  const tac_shape *shape = find_shape(wire, packet->kind, packet->link);
  size_t size = (size_t)HEADER_SIZE;
  if (is_proof(packet->kind)) {
    put_header(wire, (uint8_t)((uint8_t)ENCODED_BYTES | flag), packet, datagram);
    tac_put(&datagram[size], packet->nonce, (unsigned)NONCE_SIZE);
    return size + (size_t)NONCE_SIZE;
  }
  if (shape == NULL || packet->entries != shape->entries) {
    return 0U;
  }
  put_header(wire, (uint8_t)(shape->encoding | flag), packet, datagram);
  for (unsigned i = 0U; i < shape->entries; i++) {
    if (!put_entry(&datagram[size], shape, i, packet->values[i])) {
      return 0U;
    }
    size += width(shape->encoding);
  }
  return size;
}

size_t tac_encode(const tac_wire *wire, tac_key key, const tac_packet *packet, uint8_t *datagram) {
  uint8_t flag = (key.bytes == NULL) ? 0U : (uint8_t)AUTHENTICATED;
  size_t size = (key.bytes != NULL && !fits(key)) ? 0U : put_content(wire, flag, packet, datagram);
  if (size == 0U) {
    return 0U;
  }
  tac_put(&datagram[size], tac_checksum(0U, datagram, size), (unsigned)CRC_SIZE);
  size += (size_t)CRC_SIZE;
  if (key.bytes != NULL) {
    tac_write_tag(key, datagram, size, &datagram[size]);
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
  if (tac_get(&datagram[AT_FINGERPRINT], 8U) != wire->fingerprint && !asks(wire, datagram)) {
    return TAC_FOREIGN;
  }
  if (authenticated && !has_tag(key, datagram, end + (size_t)CRC_SIZE)) {
    return TAC_FORGED;
  }
  if (datagram[AT_KIND] >= (uint8_t)KINDS || datagram[AT_DIRECTION] > 1U ||
      (!has_both(datagram[AT_KIND]) && (datagram[AT_DIRECTION] == 1U) != is_backward(datagram[AT_KIND]))) {
    return TAC_MALFORMED;
  }
  return TAC_OK;
}

/* Return whether the policy has a link. */
static bool has_link(const tac_wire *wire, uint8_t link) {
  bool found = false;
  for (unsigned i = 0U; i < wire->shape_count; i++) {
    found = found || wire->shapes[i].link == link;
  }
  return found;
}

/* Read the nonce of a challenge or an answer. Return false if the format is wrong. */
static bool read_nonce(const tac_wire *wire, const uint8_t *datagram, size_t size, tac_packet *packet) {
  if (size != (size_t)NONCE_SIZE || (datagram[AT_ENCODING] & 0x7FU) != (unsigned)ENCODED_BYTES ||
      datagram[AT_ENTRIES] != 0U || !has_link(wire, packet->link)) {
    return false;
  }
  packet->nonce = tac_get(&datagram[HEADER_SIZE], (unsigned)NONCE_SIZE);
  return true;
}

/* Read the payload of a packet. Return false if a value is not one that payloads carry. */
static bool read_values(const tac_shape *shape, const uint8_t *payload, tac_packet *packet) {
  for (unsigned i = 0U; i < shape->entries; i++) {
    packet->values[i] = get_entry(&payload[(size_t)i * width(shape->encoding)], shape, i);
    if (!is_carried(shape, &packet->values[i])) {
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
  packet->sequence = (uint32_t)tac_get(&datagram[AT_SEQUENCE], 4U);
  packet->kind = datagram[AT_KIND];
  packet->link = asks(wire, datagram) ? find_operator(wire) : datagram[AT_LINK];
  packet->loop = (uint16_t)tac_get(&datagram[AT_LOOP], 2U);
  packet->entries = datagram[AT_ENTRIES];
  packet->back = has_both(packet->kind) && datagram[AT_DIRECTION] == 1U;
  packet->epoch = (uint32_t)tac_get(&datagram[AT_EPOCH], 4U);
  packet->tick = tac_get(&datagram[AT_TICK], 8U);
  packet->nonce = 0U;
  if (is_proof(packet->kind)) {
    return read_nonce(wire, datagram, end - (size_t)HEADER_SIZE, packet) ? TAC_OK : TAC_MALFORMED;
  }
  shape = find_shape(wire, packet->kind, packet->link);
  if (shape == NULL || (datagram[AT_ENCODING] & 0x7FU) != shape->encoding || datagram[AT_ENTRIES] != shape->entries ||
      end - (size_t)HEADER_SIZE != (size_t)shape->entries * width(shape->encoding)) {
    return TAC_MALFORMED;
  }
  return read_values(shape, &datagram[HEADER_SIZE], packet) ? TAC_OK : TAC_MALFORMED;
}

bool tac_is_back(const uint8_t *datagram) {
  return datagram[AT_DIRECTION] == 1U;
}
