/* taciturn: a node as a state machine: its start and its steps. */
#include <string.h>

#include "taciturn_parts.h"

enum { CAUGHT_UP = 10000 }; /* largest number of missed steps that are executed later */
#define NEVER UINT32_MAX

uint64_t tac_count_ticks(const tac_node *node) {
  return node->begun ? (node->tick + 1U) : 0U;
}

void tac_degrade(tac_node *node, uint64_t ticks) {
  uint64_t span = (uint64_t)node->data->remembers + 1U;
  uint64_t until = ticks + span;
  if (node->data->remembers == NEVER || until < ticks) {
    until = UINT64_MAX;
  }
  if (until > node->degraded_until) {
    node->degraded_until = until;
  }
}

/* Return whether the watchdog of a channel has expired; that of channels without data never expires. */
static bool is_silent(const tac_node *node, unsigned i) {
  uint64_t ticks = tac_count_ticks(node);
  uint64_t heard = node->channels[i].heard;
  uint32_t interval = node->data->channels[i].interval;
  uint32_t limit = ((interval > 0U) && (interval < node->watchdog)) ? interval : node->watchdog;
  bool late = limit > 0U && ticks >= heard && ticks - heard >= limit;
  return (node->data->channels[i].kind == (uint8_t)TAC_DATA) && (node->unheard || late);
}

bool tac_silent(const tac_node *node) {
  bool some = false;
  bool all = true;
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    if (node->data->channels[i].kind == (uint8_t)TAC_DATA) {
      some = true;
      all = all && is_silent(node, i);
    }
  }
  return some && all;
}

bool tac_silent_on(const tac_node *node, uint8_t link) {
  bool found = false;
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    found = found || ((node->data->channels[i].link == link) && is_silent(node, i));
  }
  return found;
}

/* Degrade the node if a link is silent. */
static void mind_silence(tac_node *node) {
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    if (is_silent(node, i)) {
      tac_degrade(node, tac_count_ticks(node));
    }
  }
}

void tac_expire(tac_node *node) {
  if (!node->unheard) {
    node->unheard = true;
    tac_degrade(node, tac_count_ticks(node));
  }
}

uint64_t tac_behind(const tac_node *node, uint64_t tick) {
  uint64_t ticks = tac_count_ticks(node);
  uint64_t behind = 0U;
  if (node->begun && node->data->measurement_count == 0U && tick > ticks) {
    behind = (tick - ticks < (uint64_t)CAUGHT_UP) ? (tick - ticks) : (uint64_t)CAUGHT_UP;
  }
  return behind;
}

static void collect_all(tac_node *node, uint8_t part, uint64_t tick) {
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    if (node->data->channels[i].part == part) {
      tac_collect(node, i, tick);
    }
  }
}

/* Return the value of a counter of the policy in a later step. */
static uint16_t place_in(const tac_node *node, unsigned i, uint64_t tick) {
  const tac_clock_data *clock = &node->data->clocks[i];
  uint64_t turns = tick - (node->begun ? node->tick : 0U);
  uint16_t place = node->places[i];
  if (turns > clock->size) { /* the counter is periodic by then: skip whole periods */
    turns = clock->size + ((turns - clock->size) % clock->period);
  }
  for (; turns > 0U; turns--) {
    place = clock->following[place];
  }
  return place;
}

/* Set every counter of the policy for a step. */
static void turn_clocks(tac_node *node, uint64_t tick) {
  for (unsigned i = 0U; i < node->data->clock_count; i++) {
    node->places[i] = place_in(node, i, tick);
    node->inputs[node->data->clocks_at + i] = (tac_real)node->places[i];
  }
}

static void copy(tac_real *to, const tac_real *from, unsigned count) {
  for (unsigned i = 0U; i < count; i++) {
    to[i] = from[i];
  }
}

/* Return whether all numbers are finite, from their exponents. */
static bool are_finite(const tac_real *numbers, unsigned count) {
  bool found = true;
  for (unsigned i = 0U; found && i < count; i++) {
    found = (tac_bits(numbers[i]) & TAC_EXPONENT) != TAC_EXPONENT;
  }
  return found;
}

/* Return whether the packets to send and the plant input of a step can be sent. */
static bool can_leave(const tac_node *node) {
  const tac_node_data *data = node->data;
  bool found = (data->applied < 0) || tac_fits(&node->outputs[data->applied], data->applied_count);
  for (unsigned i = 0U; i < data->send_count; i++) {
    const tac_real *sent = &node->outputs[data->sends[i].at];
    found = found && (!(sent[0] > (tac_real)0) || tac_fits(&sent[1], data->sends[i].entries));
  }
  return found;
}

/* Execute a part of a step. If a result is too large, start the memory again, as it may stay so, and return false. */
static bool execute(tac_node *node, bool is_second) {
  const tac_node_data *data = node->data;
  if (is_second) {
    data->second(data->constants, node->inputs, node->memory, node->outputs);
  } else {
    data->first(data->constants, node->inputs, node->memory, node->outputs);
  }
  if (are_finite(node->memory, data->memory_count) && (is_second || can_leave(node))) {
    return true;
  }
  copy(node->memory, data->start, data->memory_count);
  node->counters.overflowed++;
  tac_degrade(node, tac_count_ticks(node));
  return false;
}

/* Let the last input act in all pieces of a step. */
static void hold(tac_node *node) {
  unsigned pieces = 1U;
  unsigned each;
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    unsigned here = (node->data->channels[i].kind == (uint8_t)TAC_DATA) ? node->data->channels[i].pieces : 0U;
    pieces = (here > pieces) ? here : pieces;
  }
  each = node->data->applied_count / pieces;
  for (unsigned i = 0U; (i + each) < node->data->applied_count; i++) {
    node->input[i] = node->input[(node->data->applied_count - each) + (i % each)];
  }
}

/* Store the packets to send and the plant input of a step. */
static void put_outputs(tac_node *node) {
  const tac_node_data *data = node->data;
  for (unsigned i = 0U; i < data->send_count; i++) {
    if (node->outputs[data->sends[i].at] > (tac_real)0) {
      tac_packet *packet = &node->sending[i];
      packet->kind = (uint8_t)TAC_DATA;
      packet->link = data->sends[i].link;
      packet->entries = data->sends[i].entries;
      packet->tick = node->tick;
      node->marks[packet->link].sent = tac_count_ticks(node);
      copy(packet->values, &node->outputs[data->sends[i].at + 1U], packet->entries);
      node->pending |= UINT32_C(1) << i;
    }
  }
  if (data->applied >= 0 && !tac_silent(node)) { /* otherwise the last input is held */
    copy(node->input, &node->outputs[data->applied], data->applied_count);
  } else {
    hold(node);
  }
}

/* Return whether an entry of a measurement is missing: it is NaN, or there is no measurement. */
static bool is_missing(const tac_real *measurement, unsigned i) {
  return measurement == NULL || tac_is_nan(measurement[i]);
}

/* Copy the measurement to the inputs of the step, with 0 in place of missing entries, and state which are measured. */
static void measure(tac_node *node, const tac_real *measurement) {
  unsigned count = node->data->measurement_count;
  bool some = false;
  for (unsigned i = 0U; i < count; i++) {
    bool absent = is_missing(measurement, i);
    node->inputs[i] = absent ? (tac_real)0 : measurement[i];
    node->inputs[count + i] = absent ? (tac_real)0 : (tac_real)1;
    some = some || absent;
  }
  if (some) {
    node->counters.missing++;
    tac_degrade(node, tac_count_ticks(node));
  }
}

/* Finish the previous step, and execute this step up to its outputs. */
static void advance(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn) {
  const tac_node_data *data = node->data;
  if (data->second != NULL && node->begun) {
    collect_all(node, 1U, node->tick + 1U);
    (void)execute(node, true);
  }
  turn_clocks(node, tick);
  node->tick = tick;
  node->begun = true;
  mind_silence(node);
  measure(node, measurement);
  collect_all(node, 0U, tick);
  if (tac_is_manual(node) != NULL) {
    tac_degrade(node, tac_count_ticks(node));
  }
  if (data->draw != NULL) {
    data->draw(node->generator, &node->inputs[data->drawn_at]);
    if (drawn != NULL) {
      copy(&node->inputs[data->drawn_at], drawn, data->drawn_count);
    }
  }
  if (execute(node, false)) {
    put_outputs(node);
  } else if (data->applied >= 0) {
    hold(node);
  } else {
    /* the node applies no input */
  }
}

bool tac_act(tac_node *node) {
  const tac_node_data *data = node->data;
  uint64_t tick = tac_count_ticks(node);
  if (node->spare == NULL) {
    return false;
  }
  copy(node->spare, node->memory, data->memory_count);
  for (unsigned i = 0U; i < data->clock_count; i++) {
    node->inputs[data->clocks_at + i] = (tac_real)place_in(node, i, tick);
  }
  for (unsigned i = 0U; i < data->channel_count; i++) {
    tac_foresee(node, i, tick);
  }
  data->first(data->constants, node->inputs, node->memory, node->outputs);
  if (are_finite(node->memory, data->memory_count) && can_leave(node) && !tac_silent(node)) {
    copy(node->input, &node->outputs[data->applied], data->applied_count);
  } else {
    hold(node);
  }
  copy(node->memory, node->spare, data->memory_count);
  return true;
}

/* Let every channel that was heard from a step on, or every one if `from` is 0, be heard in step `tick`, plus one. */
static void hear_all(tac_node *node, uint64_t from, uint64_t tick) {
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    if (node->channels[i].heard >= from) {
      node->channels[i].heard = tick;
    }
  }
}

/* Execute missed steps with the packets already received, at most TAC_CATCH_UP of them; a node with a sensor skips the
 * missed steps. Return whether none is left. */
static bool make_up(tac_node *node, uint64_t tick) {
  uint64_t left_out = tick - tac_count_ticks(node);
  uint64_t behind = tac_behind(node, tick);
  uint64_t first = tick - behind;
  uint64_t count = (behind < (uint64_t)TAC_CATCH_UP) ? behind : (uint64_t)TAC_CATCH_UP;
  if (left_out == 0U) {
    return true;
  }
  if (!node->begun) {
    hear_all(node, 0U, tick);
  } else {
    node->counters.missed += (uint32_t)((left_out - behind + count) & UINT32_MAX);
    for (uint64_t i = 0U; i < count; i++) {
      advance(node, first + i, NULL, NULL);
    }
  }
  tac_degrade(node, tick + 1U);
  return count == behind;
}

/* Return whether packets could carry all entries of a measurement that are not missing. */
static bool is_measurement(const tac_node_data *data, const tac_real *measurement) {
  bool found = true;
  for (unsigned i = 0U; found && i < data->measurement_count; i++) {
    found = is_missing(measurement, i) || tac_fits(&measurement[i], 1U);
  }
  return found;
}

static unsigned find_kind(const tac_node_data *data, uint8_t kind) {
  unsigned i = 0U;
  while (i < data->channel_count && data->channels[i].kind != kind) {
    i++;
  }
  return i;
}

unsigned tac_set_points(const tac_node_data *data) {
  return find_kind(data, (uint8_t)TAC_MEASUREMENT);
}

unsigned tac_operator(const tac_node_data *data) {
  return find_kind(data, (uint8_t)TAC_SETPOINT);
}

uint8_t tac_set_point_count(const tac_node_data *data) {
  unsigned i = tac_set_points(data);
  return (i < data->channel_count) ? data->channels[i].entries : 0U;
}

bool tac_setpoint(tac_node *node, const tac_real *values) {
  unsigned i = tac_set_points(node->data);
  uint8_t count = tac_set_point_count(node->data);
  if (count == 0U || !tac_fits(values, count)) {
    return false;
  }
  copy(&node->inputs[node->data->channels[i].at + 1U], values, count);
  return true;
}

bool tac_setpoints(const tac_node *node, tac_real *values) {
  unsigned i = tac_set_points(node->data);
  uint8_t count = tac_set_point_count(node->data);
  if (count == 0U) {
    return false;
  }
  if (node->data->limited >= 0 && node->begun && tac_fits(&node->outputs[node->data->limited], count)) {
    copy(values, &node->outputs[node->data->limited], count);
  } else {
    copy(values, &node->inputs[node->data->channels[i].at + 1U], count);
  }
  return true;
}

bool tac_manual(tac_node *node, const tac_real *values) {
  const tac_node_data *data = node->data;
  if (data->manual == 0U || (values != NULL && !tac_fits(values, data->manual_count))) {
    return false;
  }
  node->inputs[data->manual] = (tac_real)((values != NULL) ? 1 : 0);
  if (values != NULL) {
    copy(&node->inputs[data->manual + 1U], values, data->manual_count);
  }
  return true;
}

const tac_real *tac_is_manual(const tac_node *node) {
  bool manual = node->data->manual > 0U && node->inputs[node->data->manual] > (tac_real)0;
  return manual ? &node->inputs[node->data->manual + 1U] : NULL;
}

void tac_report(tac_node *node) {
  node->reports = true;
  node->modes = node->data->manual > 0U;
}

bool tac_step(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn) {
  if (tick == UINT64_MAX || !is_measurement(node->data, measurement)) {
    return false;
  }
  if (node->begun && tick <= node->tick) {
    node->counters.repeated++;
    return false;
  }
  hear_all(node, tac_count_ticks(node) + 1U, tick + 1U); /* packets that arrived after the last step count from here */
  if (!make_up(node, tick)) {
    return false;
  }
  advance(node, tick, measurement, drawn);
  if (node->asked) {
    tac_report(node);
  }
  node->asked = false;
  return true;
}

uint64_t tac_heard(const tac_node *node) {
  return node->newest;
}

const tac_real *tac_input(const tac_node *node) {
  const tac_real *input = node->input;
  if (node->data->applied < 0) {
    input = NULL;
  } else if (node->safe_input != NULL && tac_silent(node)) {
    input = node->safe_input;
  } else {
    /* the last input */
  }
  return input;
}

bool tac_degraded(const tac_node *node) {
  return tac_count_ticks(node) < node->degraded_until || node->degraded_until == UINT64_MAX;
}

static void clear(tac_real *numbers, unsigned count) {
  for (unsigned i = 0U; i < count; i++) {
    numbers[i] = (tac_real)0;
  }
}

void tac_watch(tac_node *node, uint32_t ticks, const tac_real *safe_input) {
  node->watchdog = ticks;
  node->safe_input = safe_input;
}

bool tac_set_keys(tac_node *node, uint8_t link, tac_key key, tac_key other) {
  bool known = link < (uint8_t)TAC_LINKS;
  if (known) {
    node->keys[link][0] = key;
    node->keys[link][1] = other;
  }
  return known;
}

void tac_start(tac_node *node, uint32_t epoch, uint16_t loop, tac_key key) {
  const tac_node_data *data = node->data;
  unsigned given = tac_set_points(data);
  for (unsigned link = 0U; link < (unsigned)TAC_LINKS; link++) {
    const tac_key none = {NULL, 0U};
    (void)tac_set_keys(node, (uint8_t)link, key, none);
  }
  node->epoch = epoch;
  node->loop = loop;
  (void)memset(&node->counters, 0, sizeof node->counters);
  node->tick = 0U;
  node->begun = false;
  node->unheard = false;
  node->asked = false;
  node->reports = false;
  node->modes = false;
  node->newest = 0U;
  node->dated = 0U;
  node->degraded_until = 0U;
  node->pending = 0U;
  (void)memset(node->marks, 0, sizeof node->marks);
  (void)memset(node->proofs, 0, sizeof node->proofs);
  node->challenges = 0U;
  (void)memset(node->sending, 0, sizeof node->sending);
  tac_watch(node, 0U, NULL);
  tac_mark_after(node, TAC_NO_MARKS);
  (void)memcpy(node->generator, data->generator, sizeof node->generator);
  copy(node->memory, data->start, data->memory_count);
  clear(node->inputs, data->input_count);
  if (given < data->channel_count) { /* the set-points at the start follow the start values of the memory */
    copy(&node->inputs[data->channels[given].at + 1U], &data->start[data->memory_count], tac_set_point_count(data));
  }
  clear(node->outputs, data->output_count);
  for (unsigned i = 0U; i < data->channel_count; i++) {
    (void)memset(&node->channels[i], 0, sizeof node->channels[i]);
    const bool told = data->channels[i].kind == (uint8_t)TAC_ACKNOWLEDGEMENT;
    for (unsigned age = 0U; told && (age < data->channels[i].ages); age++) {
      node->inputs[data->channels[i].at + age] = (tac_real)TAC_NEVER;
    }
  }
  for (unsigned i = 0U; i < data->send_count; i++) {
    node->sequences[i] = 0U;
  }
  for (unsigned i = 0U; i < data->clock_count; i++) {
    node->places[i] = data->clocks[i].initial;
  }
  if (data->applied >= 0) {
    clear(node->input, data->applied_count);
  }
}
