/* taciturn: a node as a state machine, with the handling of received packets and the steps of the node. */
#include <string.h>

#include "taciturn.h"

#if TAC_WAITING < 4 || (TAC_WAITING & (TAC_WAITING - 1)) != 0
#error "TAC_WAITING is no power of two from 4 on"
#endif

#if TAC_FLOAT32
typedef uint32_t bits_of_real;
#define EXPONENT UINT32_C(0x7F800000)
#else
typedef uint64_t bits_of_real;
#define EXPONENT UINT64_C(0x7FF0000000000000)
#endif

enum { WIDTH = 64 };        /* width of the window of sequence numbers */
enum { CAUGHT_UP = 10000 }; /* largest number of missed steps that are executed later */
#define NEVER UINT32_MAX

typedef enum { NEW, DUPLICATE, REPLAYED } news;

/* Record a packet of a sender, and return whether it is new. */
static news admit(tac_window *window, uint32_t epoch, uint32_t sequence) {
  if (window->begun && epoch < window->epoch) {
    return REPLAYED;
  }
  if (!window->begun || epoch > window->epoch) {
    window->begun = true;
    window->epoch = epoch;
    window->newest = sequence;
    window->seen = 1U;
    window->distinct = 1U;
    return NEW;
  }
  if (sequence > window->newest) {
    uint32_t ahead = sequence - window->newest;
    window->seen = (ahead >= (uint32_t)WIDTH) ? 1U : ((window->seen << ahead) | 1U);
    window->newest = sequence;
  } else {
    uint32_t behind = window->newest - sequence;
    if (behind >= (uint32_t)WIDTH) {
      return REPLAYED;
    }
    if (((window->seen >> behind) & 1U) != 0U) {
      return DUPLICATE;
    }
    window->seen |= (uint64_t)1U << behind;
  }
  window->distinct++;
  return NEW;
}

/* Return the number of packets of this epoch, up to the newest, that have not arrived. */
static uint32_t count_missing(const tac_window *window) {
  return window->begun ? ((window->newest - window->distinct) + 1U) : 0U;
}

/* Return the number of steps that have begun. */
static uint64_t count_ticks(const tac_node *node) {
  return node->begun ? (node->tick + 1U) : 0U;
}

/* Record an event that violates an assumption of the theory, after `ticks` steps have begun. */
static void degrade(tac_node *node, uint64_t ticks) {
  uint64_t span = (uint64_t)node->data->remembers + 1U;
  uint64_t until = ticks + span;
  if (node->data->remembers == NEVER || until < ticks) {
    until = UINT64_MAX;
  }
  if (until > node->degraded_until) {
    node->degraded_until = until;
  }
}

static bool is_silent(const tac_node *node) {
  uint64_t ticks = count_ticks(node);
  return node->watchdog > 0U && ticks >= node->heard && ticks - node->heard >= node->watchdog;
}

/* Count a late packet. If the theory assumes that every packet arrives, the next step uses the newest late packet,
 * unless a step has read a newer one. */
static void miss(tac_node *node, tac_channel *channel, const tac_packet *packet) {
  node->counters.late++;
  if (packet->kind == (uint8_t)TAC_ACKNOWLEDGEMENT) {
    degrade(node, count_ticks(node));
  } else if (node->data->lossless) {
    degrade(node, count_ticks(node));
    if (channel->has_behind ? packet->tick > channel->behind.tick : packet->tick >= channel->newest) {
      channel->behind = *packet;
      channel->has_behind = true;
    }
  }
}

/* Return whether the step that reads the packet of step `tick` is past. */
static bool is_late(const tac_node *node, uint64_t tick, uint8_t lag) {
  return node->begun && tick <= node->tick && node->tick - tick >= lag;
}

static bool is_newer(const tac_packet *packet, const tac_packet *known) {
  return packet->epoch > known->epoch || (packet->epoch == known->epoch && packet->sequence > known->sequence);
}

/* Store a packet until its step. Another packet at the same place of the buffer belongs to a missed step, or arrived
 * before the first step and is too far ahead. */
static void wait_for_tick(tac_node *node, unsigned i, const tac_packet *packet) {
  tac_channel *channel = &node->channels[i];
  unsigned place = (unsigned)(packet->tick % (uint64_t)TAC_WAITING);
  const tac_packet *known = &channel->waiting[place];
  bool kept = true;
  if (channel->waits[place]) {
    if (known->tick == packet->tick) {
      node->counters.superseded++;
      kept = is_newer(packet, known);
    } else if (!node->begun) {
      kept = packet->tick > known->tick;
      miss(node, channel, kept ? known : packet);
    } else if (is_late(node, known->tick, node->data->channels[i].lag)) {
      miss(node, channel, known);
    } else {
      node->counters.ahead++;
    }
  }
  if (kept) {
    channel->waiting[place] = *packet;
    channel->waits[place] = true;
  }
}

/* Return the channel of a packet, or for a mark a channel of its sender, or the number of channels if there is none. */
static unsigned find_channel(const tac_node_data *data, const tac_packet *packet) {
  unsigned i = 0U;
  while (i < data->channel_count &&
         (data->channels[i].link != packet->link ||
          (data->channels[i].kind != packet->kind && packet->kind != (uint8_t)TAC_MARK))) {
    i++;
  }
  return i;
}

/* Return whether the step of a packet is too far ahead to be stored. */
static bool is_ahead(const tac_node *node, uint64_t tick, unsigned ahead) {
  return node->begun && tick > node->tick && tick - node->tick > ahead;
}

/* Store a new packet. */
static bool sort_in(tac_node *node, unsigned i, const tac_packet *packet) {
  bool mark = packet->kind == (uint8_t)TAC_MARK;
  uint8_t lag = mark ? 0U : node->data->channels[i].lag;
  if (is_ahead(node, packet->tick, (unsigned)TAC_WAITING - lag)) {
    node->counters.ahead++;
    return false;
  }
  if (mark) {
    node->counters.marks++;
  } else if (is_late(node, packet->tick, lag)) {
    miss(node, &node->channels[i], packet);
  } else {
    wait_for_tick(node, i, packet);
  }
  return true;
}

/* Store and count a packet, and return whether it is new and not far too early. */
static bool take(tac_node *node, const tac_packet *packet) {
  unsigned i = find_channel(node->data, packet);
  tac_channel *channel;
  news found;
  node->counters.received++;
  if (packet->loop != node->loop || i == node->data->channel_count) {
    node->counters.misdirected++;
    return false;
  }
  channel = &node->channels[i];
  found = admit((packet->kind == (uint8_t)TAC_MARK) ? &channel->marks : &channel->window, packet->epoch,
                packet->sequence);
  if (found == REPLAYED) {
    node->counters.replayed++;
  } else if (found == DUPLICATE) {
    node->counters.duplicate++;
  } else {
    if (packet->tick >= node->newest && packet->tick < UINT64_MAX) {
      node->newest = packet->tick + 1U;
    }
    return sort_in(node, i, packet);
  }
  return false;
}

static void count_refusal(tac_counters *counters, tac_verdict verdict) {
  if (verdict == TAC_MALFORMED) {
    counters->malformed++;
  } else if (verdict == TAC_CORRUPTED) {
    counters->corrupted++;
  } else if (verdict == TAC_FOREIGN) {
    counters->foreign++;
  } else {
    counters->forged++;
  }
}

bool tac_receive(tac_node *node, const uint8_t *datagram, size_t size) {
  tac_packet packet;
  tac_verdict verdict = tac_decode(&node->data->wire, node->key, datagram, size, &packet);
  if (verdict != TAC_OK) {
    count_refusal(&node->counters, verdict);
    return false;
  }
  if (!take(node, &packet)) {
    return false;
  }
  node->heard = count_ticks(node) + 1U;
  return true;
}

/* Copy a packet to the inputs of a step; NULL if no packet arrived. */
static void put_inputs(const tac_channel_data *data, const tac_packet *packet, tac_real *inputs) {
  inputs[data->at] = (tac_real)((packet == NULL) ? 0 : 1);
  for (unsigned i = 0U; i < data->entries; i++) {
    inputs[data->at + 1U + i] = (packet == NULL) ? (tac_real)0 : packet->values[i];
  }
}

/* Copy the packet that a step reads to the inputs, and acknowledge the packet if it arrived in time. */
static void collect(tac_node *node, unsigned i, uint64_t tick) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_channel *channel = &node->channels[i];
  const tac_packet *packet = NULL;
  uint32_t missing = count_missing(&channel->window);
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    tac_packet *known = &channel->waiting[place];
    if (!channel->waits[place] || tick < data->lag || known->tick > tick - data->lag) {
      continue;
    }
    channel->waits[place] = false;
    if (known->tick == tick - data->lag) {
      packet = known;
    } else {
      miss(node, channel, known);
    }
  }
  if (packet != NULL) {
    node->counters.used++;
    if (data->acknowledged && data->kind == (uint8_t)TAC_DATA) {
      channel->told = packet->tick;
      channel->tells = true;
      node->marks[data->link].sent = count_ticks(node);
    }
  } else if (channel->has_behind) {
    packet = &channel->behind;
  } else {
    /* no packet arrived */
  }
  channel->has_behind = false;
  if (packet != NULL && packet->tick >= channel->newest) {
    channel->newest = packet->tick + 1U;
  }
  if (node->data->lossless && missing > channel->missing) {
    degrade(node, count_ticks(node));
  }
  channel->missing = missing;
  put_inputs(data, packet, node->inputs);
}

static void collect_all(tac_node *node, uint8_t part, uint64_t tick) {
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    if (node->data->channels[i].part == part) {
      collect(node, i, tick);
    }
  }
}

/* Set every counter of the policy for a step. */
static void turn_clocks(tac_node *node, uint64_t tick) {
  for (unsigned i = 0U; i < node->data->clock_count; i++) {
    const tac_clock_data *clock = &node->data->clocks[i];
    uint64_t turns = tick - (node->begun ? node->tick : 0U);
    if (turns > clock->size) { /* the counter is periodic by then: skip whole periods */
      turns = clock->size + ((turns - clock->size) % clock->period);
    }
    for (; turns > 0U; turns--) {
      node->places[i] = clock->following[node->places[i]];
    }
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
    bits_of_real bits;
    (void)memcpy(&bits, &numbers[i], sizeof bits);
    found = (bits & EXPONENT) != EXPONENT;
  }
  return found;
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
      node->marks[packet->link].sent = count_ticks(node);
      copy(packet->values, &node->outputs[data->sends[i].at + 1U], packet->entries);
      node->pending = (uint8_t)(node->pending | (1U << i));
    }
  }
  if (!are_finite(node->memory, data->memory_count) || !are_finite(node->outputs, data->output_count)) {
    degrade(node, count_ticks(node));
  } else if (data->applied >= 0 && !is_silent(node)) {
    copy(node->input, &node->outputs[data->applied], data->applied_count);
  } else {
    /* the input of the last step is held */
  }
}

/* Finish the previous step, and execute this step up to its outputs. */
static void advance(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn) {
  const tac_node_data *data = node->data;
  if (data->second != NULL && node->begun) {
    collect_all(node, 1U, node->tick + 1U);
    data->second(node->inputs, node->memory, node->outputs);
  }
  turn_clocks(node, tick);
  node->tick = tick;
  node->begun = true;
  if (is_silent(node)) {
    degrade(node, count_ticks(node));
  }
  copy(node->inputs, measurement, data->measurement_count);
  collect_all(node, 0U, tick);
  if (data->draw != NULL) {
    data->draw(node->generator, &node->inputs[data->drawn_at]);
    if (drawn != NULL) {
      copy(&node->inputs[data->drawn_at], drawn, data->drawn_count);
    }
  }
  data->first(node->inputs, node->memory, node->outputs);
  put_outputs(node);
}

/* Execute missed steps with the packets already received; a node with a sensor skips the missed steps. */
static void make_up(tac_node *node, uint64_t tick) {
  uint64_t left_out = tick - count_ticks(node);
  if (left_out == 0U) {
    return;
  }
  if (!node->begun) {
    node->heard = tick;
  } else {
    node->counters.missed += (uint32_t)(left_out & UINT32_MAX);
    if (node->data->measurement_count == 0U) {
      uint64_t made_up = (left_out < (uint64_t)CAUGHT_UP) ? left_out : (uint64_t)CAUGHT_UP;
      for (uint64_t behind = tick - made_up; behind < tick; behind++) {
        advance(node, behind, NULL, NULL);
      }
    }
  }
  degrade(node, tick + 1U);
}

static bool is_measurement(const tac_node_data *data, const tac_real *measurement) {
  return data->measurement_count == 0U || (measurement != NULL && are_finite(measurement, data->measurement_count));
}

bool tac_step(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn) {
  if (tick == UINT64_MAX || !is_measurement(node->data, measurement)) {
    return false;
  }
  if (node->begun && tick <= node->tick) {
    node->counters.repeated++;
    return false;
  }
  make_up(node, tick);
  advance(node, tick, measurement, drawn);
  return true;
}

/* Begin a new epoch, in which all sequence numbers start at 0. */
static void begin_epoch(tac_node *node) {
  node->epoch++;
  for (unsigned i = 0U; i < node->data->send_count; i++) {
    node->sequences[i] = 0U;
  }
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    node->channels[i].told_sequence = 0U;
  }
  for (unsigned link = 0U; link < (unsigned)TAC_SENDS; link++) {
    node->marks[link].sequence = 0U;
  }
}

/* Number and encode a packet, and return its size, or 0 if a value is not finite. */
static size_t hand_out(tac_node *node, tac_packet *packet, uint32_t *sequence, uint8_t *datagram) {
  size_t size;
  packet->epoch = node->epoch;
  packet->loop = node->loop;
  packet->sequence = *sequence;
  if (*sequence == UINT32_MAX) {
    begin_epoch(node);
  } else {
    (*sequence)++;
  }
  size = tac_encode(&node->data->wire, node->key, packet, datagram);
  if (size == 0U) {
    node->counters.unsent++;
  }
  return size;
}

static size_t acknowledge(tac_node *node, unsigned i, uint8_t *datagram) {
  tac_channel *channel = &node->channels[i];
  tac_packet packet;
  packet.kind = (uint8_t)TAC_ACKNOWLEDGEMENT;
  packet.link = node->data->channels[i].link;
  packet.entries = 0U;
  packet.tick = channel->told;
  channel->tells = false;
  return hand_out(node, &packet, &channel->told_sequence, datagram);
}

/* Return whether a node sends data or acknowledgements on a link. */
static bool talks_on(const tac_node_data *data, uint8_t link) {
  bool found = false;
  for (unsigned i = 0U; i < data->send_count; i++) {
    found = found || data->sends[i].link == link;
  }
  for (unsigned i = 0U; i < data->channel_count; i++) {
    found = found || (data->channels[i].acknowledged && data->channels[i].link == link);
  }
  return found;
}

/* Encode a mark if it is due on a link after the last step, and return its size, or 0. */
static size_t mark(tac_node *node, uint8_t link, uint8_t *datagram) {
  tac_marks *marks = &node->marks[link];
  uint64_t ticks = count_ticks(node);
  tac_packet packet;
  if (node->mark_after == TAC_NO_MARKS || !node->begun || marks->marked == ticks || !talks_on(node->data, link) ||
      (marks->sent > 0U && ticks - marks->sent < node->mark_after)) {
    return 0U;
  }
  marks->marked = ticks;
  marks->sent = ticks;
  packet.kind = (uint8_t)TAC_MARK;
  packet.link = link;
  packet.entries = 0U;
  packet.tick = node->tick;
  return hand_out(node, &packet, &marks->sequence, datagram);
}

size_t tac_send(tac_node *node, uint8_t *datagram) {
  size_t size = 0U;
  for (unsigned i = 0U; size == 0U && i < node->data->channel_count; i++) {
    if (node->channels[i].tells) {
      size = acknowledge(node, i, datagram);
    }
  }
  for (unsigned i = 0U; size == 0U && i < node->data->send_count; i++) {
    if ((node->pending & (1U << i)) != 0U) {
      node->pending = (uint8_t)(node->pending & ~(1U << i));
      size = hand_out(node, &node->sending[i], &node->sequences[i], datagram);
    }
  }
  for (unsigned link = 0U; size == 0U && link < (unsigned)TAC_SENDS; link++) {
    size = mark(node, (uint8_t)link, datagram);
  }
  return size;
}

uint64_t tac_heard(const tac_node *node) {
  return node->newest;
}

const tac_real *tac_input(const tac_node *node) {
  const tac_real *input = node->input;
  if (node->data->applied < 0) {
    input = NULL;
  } else if (node->safe_input != NULL && is_silent(node)) {
    input = node->safe_input;
  } else {
    /* the last input */
  }
  return input;
}

bool tac_degraded(const tac_node *node) {
  return count_ticks(node) < node->degraded_until || node->degraded_until == UINT64_MAX;
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

void tac_mark_after(tac_node *node, uint32_t ticks) {
  node->mark_after = ticks;
}

void tac_start(tac_node *node, uint32_t epoch, uint16_t loop, tac_key key) {
  const tac_node_data *data = node->data;
  node->key = key;
  node->epoch = epoch;
  node->loop = loop;
  (void)memset(&node->counters, 0, sizeof node->counters);
  node->tick = 0U;
  node->begun = false;
  node->heard = 0U;
  node->newest = 0U;
  node->degraded_until = 0U;
  node->pending = 0U;
  (void)memset(node->marks, 0, sizeof node->marks);
  tac_watch(node, 0U, NULL);
  tac_mark_after(node, TAC_NO_MARKS);
  (void)memcpy(node->generator, data->generator, sizeof node->generator);
  copy(node->memory, data->start, data->memory_count);
  clear(node->inputs, data->input_count);
  clear(node->outputs, data->output_count);
  for (unsigned i = 0U; i < data->channel_count; i++) {
    (void)memset(&node->channels[i], 0, sizeof node->channels[i]);
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
