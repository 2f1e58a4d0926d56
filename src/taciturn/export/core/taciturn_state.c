/* taciturn: the check of a node's constant data. */
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
  const uint16_t sizes[7] = {data->input_count, data->memory_count, data->output_count,      data->clocks_at,
                             data->drawn_at,    data->drawn_count,  (uint16_t)data->applied};
  const uint8_t counts[6] = {data->measurement_count, data->applied_count, data->channel_count,
                             data->send_count,        data->clock_count,   data->wire.shape_count};
  uint32_t sum = 0U;
  if (data->format != TAC_FORMAT) {
    return false;
  }
  add(&sum, data->format, 4U);
  for (unsigned i = 0U; i < 7U; i++) {
    add(&sum, sizes[i], 2U);
  }
  for (unsigned i = 0U; i < 6U; i++) {
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
  add_reals(&sum, data->start, data->memory_count);
  add_reals(&sum, data->constants, data->constant_count);
  return sum == data->crc;
}
