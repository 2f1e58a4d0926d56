/* taciturn: the check of a node's constant data, and its state as bytes. */
#include <string.h>

#include "taciturn_parts.h"

/* Add a number to a checksum, as big-endian bytes. */
static void add(uint32_t *sum, uint64_t value, unsigned bytes) {
  uint8_t content[8];
  tac_put(content, value, bytes);
  *sum = tac_checksum(*sum, content, bytes);
}

static void add_reals(uint32_t *sum, const tac_real *numbers, uint32_t count) {
  for (uint32_t i = 0U; numbers != NULL && i < count; i++) {
    add(sum, tac_bits(numbers[i]), (unsigned)sizeof(tac_real));
  }
}

static void add_wire(uint32_t *sum, const tac_wire *wire) {
  add(sum, wire->fingerprint, 8U);
  for (unsigned i = 0U; i < wire->shape_count; i++) {
    const tac_shape *shape = &wire->shapes[i];
    add(sum, shape->kind, 1U);
    add(sum, shape->link, 1U);
    add(sum, shape->encoding, 1U);
    add(sum, shape->entries, 1U);
    add(sum, shape->samples ? 1U : 0U, 1U);
    add_reals(sum, shape->per_unit, shape->entries);
    add_reals(sum, shape->per_step, shape->entries);
  }
}

static void add_packets(uint32_t *sum, const tac_node_data *data) {
  for (unsigned i = 0U; i < data->channel_count; i++) {
    const tac_channel_data *channel = &data->channels[i];
    add(sum, channel->kind, 1U);
    add(sum, channel->link, 1U);
    add(sum, channel->lag, 1U);
    add(sum, channel->part, 1U);
    add(sum, channel->entries, 1U);
    add(sum, channel->acknowledged ? 1U : 0U, 1U);
    add(sum, channel->at, 2U);
    add(sum, channel->interval, 4U);
    add(sum, channel->pieces, 1U);
    add(sum, channel->ages, 1U);
  }
  for (unsigned i = 0U; i < data->send_count; i++) {
    add(sum, data->sends[i].link, 1U);
    add(sum, data->sends[i].entries, 1U);
    add(sum, data->sends[i].at, 2U);
  }
}

static void add_clocks(uint32_t *sum, const tac_node_data *data) {
  for (unsigned i = 0U; i < data->clock_count; i++) {
    const tac_clock_data *clock = &data->clocks[i];
    for (unsigned k = 0U; k < clock->size; k++) {
      add(sum, clock->following[k], 2U);
    }
    add(sum, clock->period, 2U);
    add(sum, clock->initial, 2U);
  }
}

bool tac_check(const tac_node_data *data) {
  const uint16_t sizes[9] = {data->input_count, data->memory_count, data->output_count,
                             data->clocks_at,   data->drawn_at,     data->drawn_count,
                             data->manual,      (uint16_t)data->applied, (uint16_t)data->limited};
  const uint8_t counts[7] = {data->measurement_count, data->applied_count, data->channel_count,     data->send_count,
                             data->clock_count,       data->manual_count,  data->wire.shape_count};
  uint32_t sum = 0U;
  if (data->format != TAC_FORMAT) {
    return false;
  }
  add(&sum, data->format, 4U);
  for (unsigned i = 0U; i < 9U; i++) {
    add(&sum, sizes[i], 2U);
  }
  for (unsigned i = 0U; i < 7U; i++) {
    add(&sum, counts[i], 1U);
  }
  add(&sum, data->lossless ? 1U : 0U, 1U);
  add(&sum, data->remembers, 4U);
  add(&sum, data->constant_count, 4U);
  for (unsigned i = 0U; i < 4U; i++) {
    add(&sum, data->generator[i], 8U);
  }
  add_wire(&sum, &data->wire);
  add_packets(&sum, data);
  add_clocks(&sum, data);
  add_reals(&sum, data->start, data->memory_count + (uint32_t)tac_set_point_count(data));
  add_reals(&sum, data->constants, data->constant_count);
  return sum == data->crc;
}

/* What happens to the fields of a node: they are written, their ranges are checked, or they are read. */
typedef enum { WRITE, CHECK, READ } purpose;

enum { END = 4 }; /* bytes after the fields: their CRC */

typedef struct {
  uint8_t *to;
  const uint8_t *from;
  size_t at;
  size_t size;
  purpose why;
  bool valid; /* whether there is room, and all values are in their ranges */
} cursor;

/* Handle a field of `bytes` bytes that is at most `most`, and return its new value. */
static uint64_t pass(cursor *c, uint64_t value, unsigned bytes, uint64_t most) {
  uint64_t found = value;
  if (c->size - c->at < bytes) {
    c->valid = false;
    return value;
  }
  if (c->why == WRITE) {
    tac_put(&c->to[c->at], value, bytes);
  } else {
    found = tac_get(&c->from[c->at], bytes);
    c->valid = c->valid && found <= most;
  }
  c->at += bytes;
  return (c->why == READ) ? found : value;
}

static void pass_truth(cursor *c, bool *field) {
  *field = pass(c, *field ? 1U : 0U, 1U, 1U) != 0U;
}

static void pass_half(cursor *c, uint16_t *field, uint16_t most) {
  *field = (uint16_t)pass(c, *field, 2U, most);
}

static void pass_word(cursor *c, uint32_t *field) {
  *field = (uint32_t)pass(c, *field, 4U, UINT32_MAX);
}

static void pass_long(cursor *c, uint64_t *field) {
  *field = pass(c, *field, 8U, UINT64_MAX);
}

static void pass_reals(cursor *c, tac_real *numbers, unsigned count) {
  for (unsigned i = 0U; i < count; i++) {
    tac_word bits = (tac_word)pass(c, tac_bits(numbers[i]), (unsigned)sizeof bits, UINT64_MAX);
    (void)memcpy(&numbers[i], &bits, sizeof bits);
  }
}

/* Handle a packet, whose kind and link are known. */
static void pass_packet(cursor *c, const tac_node *node, tac_packet *packet, uint8_t kind, uint8_t link,
                        uint8_t count) {
  pass_long(c, &packet->tick);
  pass_word(c, &packet->sequence);
  pass_word(c, &packet->epoch);
  pass_reals(c, packet->values, count);
  if (c->why == READ) {
    packet->loop = node->loop;
    packet->kind = kind;
    packet->link = link;
    packet->entries = count;
  }
}

static void pass_window(cursor *c, tac_window *window) {
  pass_long(c, &window->seen);
  pass_word(c, &window->epoch);
  pass_word(c, &window->newest);
  pass_word(c, &window->distinct);
  pass_truth(c, &window->begun);
}

static void pass_channel(cursor *c, const tac_node *node, unsigned i) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_channel *channel = &node->channels[i];
  pass_window(c, &channel->window);
  pass_window(c, &channel->marks);
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    pass_truth(c, &channel->waits[place]);
    pass_truth(c, &channel->tells_early[place]);
    channel->piece[place] = (uint8_t)pass(c, channel->piece[place], 1U, UINT8_MAX);
    pass_packet(c, node, &channel->waiting[place], data->kind, data->link, data->entries);
  }
  pass_truth(c, &channel->has_behind);
  pass_packet(c, node, &channel->behind, data->kind, data->link, data->entries);
  pass_long(c, &channel->newest);
  pass_long(c, &channel->heard);
  pass_long(c, &channel->marked);
  pass_word(c, &channel->missing);
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    pass_long(c, &channel->told[place]);
    pass_half(c, &channel->after[place], UINT16_MAX);
  }
  channel->tells = (uint8_t)pass(c, channel->tells, 1U, (uint64_t)TAC_WAITING);
  pass_word(c, &channel->told_sequence);
  pass_truth(c, &channel->has_proof);
  pass_word(c, &channel->proven);
  pass_long(c, &channel->first);
  pass_truth(c, &channel->challenged);
  pass_truth(c, &channel->challenges);
  pass_word(c, &channel->challenge);
}

/* Handle what the node has sent and is to send. */
static void pass_sends(cursor *c, tac_node *node) {
  const tac_node_data *data = node->data;
  for (unsigned i = 0U; i < data->send_count; i++) {
    pass_word(c, &node->sequences[i]);
    pass_packet(c, node, &node->sending[i], (uint8_t)TAC_DATA, data->sends[i].link, data->sends[i].entries);
  }
  for (unsigned link = 0U; link < (unsigned)TAC_LINKS; link++) {
    pass_long(c, &node->marks[link].sent);
    pass_long(c, &node->marks[link].marked);
    pass_word(c, &node->marks[link].sequence);
    pass_long(c, &node->proofs[link].nonce);
    pass_long(c, &node->proofs[link].repeated);
    pass_truth(c, &node->proofs[link].answers);
    node->proofs[link].again = (uint8_t)pass(c, node->proofs[link].again, 1U, 3U);
  }
  node->pending =
      (uint32_t)pass(c, node->pending, (data->send_count > 8U) ? 4U : 1U, (UINT32_C(1) << data->send_count) - 1U);
}

/* Handle all fields of the state of a node. */
static void pass_all(cursor *c, tac_node *node) {
  const tac_node_data *data = node->data;
  uint32_t counts[sizeof node->counters / sizeof(uint32_t)];
  (void)memcpy(counts, &node->counters, sizeof counts);
  for (size_t i = 0U; i < sizeof counts / sizeof counts[0]; i++) {
    pass_word(c, &counts[i]);
  }
  (void)memcpy(&node->counters, counts, sizeof counts);
  pass_word(c, &node->epoch);
  pass_word(c, &node->challenges);
  pass_long(c, &node->tick);
  pass_long(c, &node->newest);
  pass_long(c, &node->degraded_until);
  pass_truth(c, &node->begun);
  pass_truth(c, &node->unheard);
  for (unsigned i = 0U; i < 4U; i++) {
    pass_long(c, &node->generator[i]);
  }
  pass_reals(c, node->memory, data->memory_count);
  pass_reals(c, node->inputs, data->input_count);
  pass_reals(c, node->input, (data->applied < 0) ? 0U : data->applied_count);
  if (data->limited >= 0) {
    pass_reals(c, &node->outputs[data->limited], tac_set_point_count(data));
  }
  for (unsigned i = 0U; i < data->clock_count; i++) {
    pass_half(c, &node->places[i], (uint16_t)(data->clocks[i].size - 1U));
  }
  for (unsigned i = 0U; i < data->channel_count; i++) {
    pass_channel(c, node, i);
  }
  pass_sends(c, node);
}

/* Handle what a saved state begins with, which says to which node it belongs, and return whether it is this node. */
static bool pass_begin(cursor *c, const tac_node *node) {
  bool same = pass(c, TAC_FORMAT, 4U, UINT64_MAX) == TAC_FORMAT;
  same = pass(c, node->data->wire.fingerprint, 8U, UINT64_MAX) == node->data->wire.fingerprint && same;
  same = pass(c, node->data->crc, 4U, UINT64_MAX) == node->data->crc && same;
  return pass(c, node->loop, 2U, UINT64_MAX) == node->loop && same;
}

size_t tac_save(tac_node *node, uint8_t *bytes, size_t size) {
  cursor c = {bytes, bytes, 0U, size, WRITE, true};
  (void)pass_begin(&c, node);
  pass_all(&c, node);
  if (!c.valid || size - c.at < (size_t)END) {
    return 0U;
  }
  tac_put(&bytes[c.at], tac_checksum(0U, bytes, c.at), (unsigned)END);
  return c.at + (size_t)END;
}

bool tac_restore(tac_node *node, const uint8_t *bytes, size_t size) {
  cursor c = {NULL, bytes, 0U, (size < (size_t)END) ? 0U : (size - (size_t)END), READ, true};
  size_t begin;
  if (size < (size_t)END || tac_get(&bytes[c.size], (unsigned)END) != tac_checksum(0U, bytes, c.size) ||
      !pass_begin(&c, node)) {
    return false;
  }
  begin = c.at;
  c.why = CHECK;
  pass_all(&c, node);
  if (!c.valid || c.at != c.size) {
    return false;
  }
  c.at = begin;
  c.why = READ;
  pass_all(&c, node);
  return true;
}
