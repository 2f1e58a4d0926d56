/* taciturn: the handling of received packets: each packet is checked, counted, and stored until its step reads it. */
#include <string.h>

#include "taciturn_parts.h"

#if TAC_WAITING < 4 || (TAC_WAITING & (TAC_WAITING - 1)) != 0
#error "TAC_WAITING is no power of two from 4 on"
#endif

enum { LINK_AT = 6 };    /* position of the link in a datagram */
enum { ANY_LINK = 255 }; /* in the challenge of an operator, who does not know the link */
enum { WIDTH = 64 };  /* width of the window of sequence numbers */

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

/* Count a late packet. If the theory assumes that every packet arrives, the next step uses the newest late packet,
 * unless a step has read a newer one. */
static void miss(tac_node *node, tac_channel *channel, const tac_packet *packet) {
  node->counters.late++;
  if (packet->kind == (uint8_t)TAC_MEASUREMENT) { /* set-points take effect in the next step */
    if (!channel->has_behind || packet->tick >= channel->behind.tick) {
      channel->behind = *packet;
      channel->has_behind = true;
    }
  } else if (packet->kind == (uint8_t)TAC_ACKNOWLEDGEMENT) {
    tac_degrade(node, tac_count_ticks(node));
  } else if (node->data->lossless) {
    tac_degrade(node, tac_count_ticks(node));
    if (channel->has_behind ? packet->tick > channel->behind.tick : packet->tick >= channel->newest) {
      channel->behind = *packet;
      channel->has_behind = true;
    }
  } else {
    /* the packet is only counted */
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
static void wait_for_tick(tac_node *node, unsigned i, const tac_packet *packet, uint8_t piece) {
  tac_channel *channel = &node->channels[i];
  unsigned place = (unsigned)(packet->tick % (uint64_t)TAC_WAITING);
  const tac_packet *known = &channel->waiting[place];
  bool kept = true;
  if (channel->waits[place]) {
    if (known->tick == packet->tick) {
      node->counters.superseded++;
      kept = is_newer(packet, known);
    } else if (node->data->channels[i].pieces > 0U) {
      node->counters.superseded++;
      kept = packet->tick > known->tick;
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
    channel->piece[place] = piece;
    channel->tells_early[place] = false;
  }
}

/* Return whether a channel receives packets of this kind and direction, or the marks of their sender. */
static bool receives(const tac_channel_data *channel, const tac_packet *packet) {
  bool back = channel->kind == (uint8_t)TAC_ACKNOWLEDGEMENT;
  bool mark = packet->kind == (uint8_t)TAC_MARK && packet->back == back;
  return channel->link == packet->link && (mark || channel->kind == packet->kind);
}

/* Return the channel of a packet, or for a mark a channel of its sender, or the number of channels if there is none. */
static unsigned find_channel(const tac_node_data *data, const tac_packet *packet) {
  unsigned i = 0U;
  while (i < data->channel_count && !receives(&data->channels[i], packet)) {
    i++;
  }
  return i;
}

/* Return whether the step of a packet is too far ahead to be stored. */
static bool is_ahead(const tac_node *node, uint64_t tick, unsigned ahead) {
  return node->begun && tick > node->tick && tick - node->tick > ahead;
}

/* Store a packet of an operator, who does not know the step: the newest takes effect in the next step. */
static bool sort_by_number(tac_node *node, unsigned i, const tac_packet *packet, const tac_window *before) {
  tac_packet next = *packet;
  if (before->begun && packet->epoch == before->epoch && packet->sequence < before->newest) {
    node->counters.superseded++;
    return false;
  }
  next.tick = tac_count_ticks(node);
  wait_for_tick(node, i, &next, 0U);
  return true;
}

/* Return the number of pieces of a step after which a packet has arrived, as its acknowledgement states it. */
static uint64_t told_after(const tac_packet *packet) {
  uint64_t after = 0U;
  if (packet->values[0] > (tac_real)0) {
    after = (packet->values[0] < (tac_real)TAC_NEVER) ? (uint64_t)packet->values[0] : (uint64_t)TAC_NEVER;
  }
  return after;
}

/* Return the step that hears a packet unless it is late; of an acknowledgement, the one in which its packet arrived. */
static uint64_t due_step(const tac_channel_data *data, const tac_packet *packet) {
  bool told = (data->kind == (uint8_t)TAC_ACKNOWLEDGEMENT) && (data->ages > 0U);
  return packet->tick + (told ? (told_after(packet) / data->pieces) : 0U);
}

/* Store a new packet. */
static bool sort_in(tac_node *node, unsigned i, const tac_packet *packet, uint8_t piece) {
  bool mark = packet->kind == (uint8_t)TAC_MARK;
  uint8_t lag = mark ? 0U : node->data->channels[i].lag;
  if (is_ahead(node, packet->tick, (unsigned)TAC_WAITING - lag)) {
    node->counters.ahead++;
    return false;
  }
  if (mark) {
    node->counters.marks++;
    if (packet->tick < UINT64_MAX && packet->tick >= node->channels[i].marked) {
      node->channels[i].marked = packet->tick + 1U;
    }
  } else if (is_late(node, due_step(&node->data->channels[i], packet), lag) &&
             ((node->data->channels[i].pieces == 0U) || (packet->kind == (uint8_t)TAC_ACKNOWLEDGEMENT))) {
    miss(node, &node->channels[i], packet);
  } else {
    wait_for_tick(node, i, packet, (piece < node->data->channels[i].pieces) ? piece : 0U);
  }
  return true;
}

/* Return the channel whose window counts the packets of channel `i`: an operator numbers all his packets together. */
static unsigned numbered_by(const tac_node_data *data, unsigned i) {
  return (data->channels[i].kind == (uint8_t)TAC_MANUAL) ? tac_operator(data) : i;
}

static void forget(tac_node *node, unsigned i) {
  tac_channel *channel = &node->channels[i];
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    node->counters.superseded += channel->waits[place] ? 1U : 0U;
    channel->waits[place] = false;
  }
  channel->has_behind = false;
}

void tac_forget_numbered(tac_node *node, unsigned i) {
  for (unsigned k = 0U; k < node->data->channel_count; k++) {
    if (numbered_by(node->data, k) == i) {
      forget(node, k);
    }
  }
}

/* Store and count a packet, and return whether it is new and not far too early. */
static bool take(tac_node *node, const tac_packet *packet, uint8_t piece) {
  unsigned i = find_channel(node->data, packet);
  bool known = packet->loop == node->loop && i < node->data->channel_count;
  unsigned number = known ? numbered_by(node->data, i) : i;
  bool operated = packet->kind == (uint8_t)TAC_SETPOINT || packet->kind == (uint8_t)TAC_MANUAL;
  tac_channel *channel;
  tac_window *window;
  tac_window before;
  bool kept = false;
  news found;
  if (known && !tac_is_admitted(node, number, packet)) {
    return false;
  }
  node->counters.received++;
  if (!known) {
    node->counters.misdirected++;
    return false;
  }
  channel = &node->channels[i];
  window = &node->channels[number].window;
  before = *window;
  node->asked = node->asked || operated;
  if (packet->kind != (uint8_t)TAC_MARK && window->begun && packet->epoch > window->epoch) {
    tac_forget_numbered(node, number);
  }
  found = admit((packet->kind == (uint8_t)TAC_MARK) ? &channel->marks : window, packet->epoch, packet->sequence);
  if (found == REPLAYED) {
    node->counters.replayed++;
  } else if (found == DUPLICATE) {
    node->counters.duplicate++;
  } else if (operated) {
    kept = sort_by_number(node, i, packet, &before);
  } else {
    bool timed = packet->kind != (uint8_t)TAC_MEASUREMENT; /* the sender of set-points need not know the step */
    if (timed && packet->tick >= node->newest && packet->tick < UINT64_MAX) {
      node->newest = packet->tick + 1U;
    }
    if (node->data->channels[i].kind == (uint8_t)TAC_DATA && packet->tick < UINT64_MAX) {
      node->dated = packet->tick + 1U;
    }
    kept = sort_in(node, i, packet, piece);
  }
  if (kept) {
    channel->heard = tac_count_ticks(node) + 1U;
    node->unheard = node->unheard && (node->data->channels[i].kind != (uint8_t)TAC_DATA);
  }
  return kept;
}

bool tac_ready(const tac_node *node) {
  uint64_t tick = tac_count_ticks(node);
  bool ready = node->begun || node->data->measurement_count > 0U || node->counters.received > 0U;
  for (unsigned i = 0U; ready && i < node->data->channel_count; i++) {
    const tac_channel *channel = &node->channels[i];
    unsigned place = (unsigned)(tick % (uint64_t)TAC_WAITING);
    if (node->data->channels[i].kind == (uint8_t)TAC_MEASUREMENT) {
      ready = channel->waits[place] && channel->waiting[place].tick == tick;
    } else if (node->data->channels[i].kind == (uint8_t)TAC_SETPOINT ||
               node->data->channels[i].kind == (uint8_t)TAC_MANUAL) {
      /* an operator need not send any */
    } else {
      ready = channel->marked + node->data->channels[i].lag > tick;
    }
  }
  return ready;
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

/* Decode a datagram with the keys of its link. If only other links have keys, their packets show that a tag is
 * expected, but no tag is correct. */
static tac_verdict decode(const tac_node *node, const uint8_t *datagram, size_t size, tac_packet *packet) {
  unsigned link = (size > (size_t)LINK_AT) ? datagram[LINK_AT] : 0U;
  unsigned own = tac_operator(node->data);
  const tac_key *keys;
  bool has_key;
  tac_verdict verdict;
  if (link == (unsigned)ANY_LINK && own < node->data->channel_count) {
    link = node->data->channels[own].link;
  }
  keys = node->keys[(link < (unsigned)TAC_LINKS) ? link : 0U];
  has_key = keys[0].bytes != NULL;
  for (unsigned i = 0U; !has_key && keys[0].bytes == NULL && i < (unsigned)TAC_LINKS; i++) {
    keys = node->keys[i];
  }
  verdict = tac_decode(&node->data->wire, keys[0], datagram, size, packet);
  if (has_key && verdict == TAC_FORGED && keys[1].bytes != NULL) {
    verdict = tac_decode(&node->data->wire, keys[1], datagram, size, packet);
  }
  return (verdict == TAC_OK && !has_key && keys[0].bytes != NULL) ? TAC_FORGED : verdict;
}

bool tac_receive(tac_node *node, const uint8_t *datagram, size_t size) {
  return tac_receive_in(node, datagram, size, 0U);
}

bool tac_receive_in(tac_node *node, const uint8_t *datagram, size_t size, uint8_t piece) {
  tac_packet packet;
  tac_verdict verdict = decode(node, datagram, size, &packet);
  if (verdict != TAC_OK) {
    count_refusal(&node->counters, verdict);
    return false;
  }
  if (packet.kind == (uint8_t)TAC_CHALLENGE || packet.kind == (uint8_t)TAC_ANSWER) {
    tac_take_proof(node, &packet);
    return false;
  }
  return take(node, &packet, piece);
}

/* Copy a packet to the inputs of a step, from `at` on; NULL if no packet arrived. */
static void put_at(const tac_channel_data *data, const tac_packet *packet, tac_real *inputs, unsigned at) {
  inputs[at] = (tac_real)((packet == NULL) ? 0 : 1);
  for (unsigned i = 0U; i < data->entries; i++) {
    inputs[at + 1U + i] = (packet == NULL) ? (tac_real)0 : packet->values[i];
  }
}

static void put_inputs(const tac_channel_data *data, const tac_packet *packet, tac_real *inputs) {
  put_at(data, packet, inputs, data->at);
}

/* Return whether other set-points than those of a channel have no effect, because an operator has given some. */
static bool is_overruled(const tac_node *node, unsigned i) {
  unsigned own = tac_operator(node->data);
  bool simulated = node->data->channels[i].kind == (uint8_t)TAC_MEASUREMENT;
  return own < node->data->channel_count && simulated && node->channels[own].newest > 0U;
}

/* Copy the newest set-points of this step or of an earlier one to the inputs; without any, the last remain. */
static void collect_kept(tac_node *node, unsigned i, uint64_t tick) {
  tac_channel *channel = &node->channels[i];
  const tac_packet *packet = NULL;
  bool overruled = is_overruled(node, i);
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    const tac_packet *known = &channel->waiting[place];
    if (channel->waits[place] && known->tick <= tick) {
      channel->waits[place] = false;
      node->counters.used += overruled ? 0U : 1U;
      node->counters.overruled += overruled ? 1U : 0U;
      packet = (packet == NULL || known->tick > packet->tick) ? known : packet;
    }
  }
  if (channel->has_behind) {
    channel->has_behind = false;
    packet = (packet == NULL || channel->behind.tick >= packet->tick) ? &channel->behind : packet;
  }
  if (packet != NULL && !overruled && packet->tick + 1U >= channel->newest) {
    channel->newest = packet->tick + 1U;
    put_inputs(&node->data->channels[i], packet, node->inputs);
  }
}

/* Read for each age in which piece of a step the packet of this age arrived. */
static void collect_told(tac_node *node, unsigned i, uint64_t step) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_channel *channel = &node->channels[i];
  for (unsigned age = 0U; age < data->ages; age++) {
    node->inputs[data->at + age] = (tac_real)TAC_NEVER;
  }
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    tac_packet *known = &channel->waiting[place];
    uint64_t due = due_step(data, known);
    if (!channel->waits[place] || (due > step)) {
      continue;
    }
    channel->waits[place] = false;
    if ((due < step) || ((step - known->tick) >= data->ages)) {
      miss(node, channel, known);
    } else {
      node->counters.used++;
      uint64_t piece = told_after(known) % data->pieces;
      node->inputs[data->at + (unsigned)(step - known->tick)] = (tac_real)piece;
    }
  }
}

/* Acknowledge the packet of a step, read after so many pieces of a step; the oldest is forgotten if there are many. */
static void tell(tac_channel *channel, uint64_t sent, uint64_t after) {
  unsigned place = channel->tells;
  if (place == (unsigned)TAC_WAITING) {
    place = 0U;
    for (unsigned other = 1U; other < (unsigned)TAC_WAITING; other++) {
      place = (channel->told[other] < channel->told[place]) ? other : place;
    }
  } else {
    channel->tells++;
  }
  channel->told[place] = sent;
  channel->after[place] = (after < (uint64_t)UINT16_MAX) ? (uint16_t)after : UINT16_MAX;
}

/* Return whether a packet of a late link is heard in a step: it has arrived, and no step has read a newer one. */
static bool is_heard(const tac_channel *channel, unsigned place, uint64_t step) {
  const tac_packet *known = &channel->waiting[place];
  return channel->waits[place] && (known->tick <= step) && (known->tick >= channel->newest);
}

/* Acknowledge the packet at a place, which is read in a step, unless this was done; `ticks` is the step, plus one. */
static void tell_once(tac_node *node, unsigned i, unsigned place, uint64_t step, uint64_t ticks) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_channel *channel = &node->channels[i];
  uint64_t sent = channel->waiting[place].tick;
  if (data->acknowledged && !channel->tells_early[place]) {
    tell(channel, sent, ((step - sent) * data->pieces) + channel->piece[place]);
    channel->tells_early[place] = true;
    node->marks[data->link].sent = ticks;
  }
}

/* Copy the newest packet of each piece of a step to the inputs, and acknowledge all. Set `used` to whether the packet
 * at each place is used. */
static void put_newest(tac_node *node, unsigned i, uint64_t step, uint64_t ticks, bool *used) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_channel *channel = &node->channels[i];
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    used[place] = false;
  }
  for (unsigned piece = 0U; piece < data->pieces; piece++) {
    const tac_packet *packet = NULL;
    unsigned best = (unsigned)TAC_WAITING;
    for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
      if (is_heard(channel, place, step) && (channel->piece[place] <= piece) &&
          ((best == (unsigned)TAC_WAITING) || (channel->waiting[place].tick > channel->waiting[best].tick))) {
        best = place;
      }
    }
    if (best < (unsigned)TAC_WAITING) {
      used[best] = true;
      packet = &channel->waiting[best];
    }
    put_at(data, packet, node->inputs, data->at + (piece * (1U + data->entries)));
    if (packet != NULL) { /* a receiver may use the packet by its age */
      uint64_t age = step - packet->tick;
      node->inputs[data->at + (piece * (1U + data->entries))] += (tac_real)age;
    }
  }
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    if (is_heard(channel, place, step)) {
      tell_once(node, i, place, step, ticks);
    }
  }
}

/* Read all packets that have arrived, for each age the one that was sent so many steps ago, and acknowledge them. */
static void collect_each(tac_node *node, unsigned i, uint64_t step) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_channel *channel = &node->channels[i];
  for (unsigned age = 0U; age < data->ages; age++) {
    put_at(data, NULL, node->inputs, data->at + (age * (1U + data->entries)));
  }
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    const tac_packet *known = &channel->waiting[place];
    if (!channel->waits[place] || (known->tick > step)) {
      continue;
    }
    channel->waits[place] = false;
    if ((step - known->tick) >= data->ages) {
      miss(node, channel, known);
      continue;
    }
    node->counters.used++;
    put_at(data, known, node->inputs, data->at + ((unsigned)(step - known->tick) * (1U + data->entries)));
    tell_once(node, i, place, step, tac_count_ticks(node));
    channel->newest = (known->tick >= channel->newest) ? (known->tick + 1U) : channel->newest;
  }
  channel->missing = count_missing(&channel->window);
}

/* Read the newest packets that have arrived, unless a step has read newer ones. */
static void collect_late(tac_node *node, unsigned i, uint64_t step) {
  tac_channel *channel = &node->channels[i];
  bool used[TAC_WAITING];
  put_newest(node, i, step, tac_count_ticks(node), used);
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    const tac_packet *known = &channel->waiting[place];
    if (!channel->waits[place] || (known->tick > step)) {
      continue;
    }
    channel->waits[place] = false;
    if (!used[place]) {
      node->counters.superseded++;
    } else {
      node->counters.used++;
      channel->newest = (known->tick >= channel->newest) ? (known->tick + 1U) : channel->newest;
    }
  }
  channel->missing = count_missing(&channel->window);
}

void tac_foresee(tac_node *node, unsigned i, uint64_t tick) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_channel *channel = &node->channels[i];
  unsigned place = (unsigned)((tick - data->lag) % (uint64_t)TAC_WAITING);
  const tac_packet *packet = channel->has_behind ? &channel->behind : NULL;
  if (data->pieces > 0U) {
    bool used[TAC_WAITING];
    put_newest(node, i, tick - data->lag, tick + 1U, used);
    return;
  }
  if ((tick >= data->lag) && channel->waits[place] && (channel->waiting[place].tick == (tick - data->lag))) {
    packet = &channel->waiting[place];
    tell_once(node, i, place, packet->tick, tick + 1U);
  }
  put_inputs(data, packet, node->inputs);
}

/* Read packets of several steps: set-points, and those of late links. */
static void collect_several(tac_node *node, unsigned i, uint64_t tick) {
  const tac_channel_data *data = &node->data->channels[i];
  if (data->pieces == 0U) {
    collect_kept(node, i, tick);
  } else if (data->kind == (uint8_t)TAC_ACKNOWLEDGEMENT) {
    collect_told(node, i, tick - data->lag);
  } else if (data->ages > 0U) {
    collect_each(node, i, tick - data->lag);
  } else {
    collect_late(node, i, tick - data->lag);
  }
}

void tac_collect(tac_node *node, unsigned i, uint64_t tick) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_channel *channel = &node->channels[i];
  const tac_packet *packet = NULL;
  bool told = false;
  uint32_t missing = count_missing(&channel->window);
  if (data->kind == (uint8_t)TAC_MEASUREMENT || data->kind == (uint8_t)TAC_SETPOINT ||
      data->kind == (uint8_t)TAC_MANUAL || data->pieces > 0U) {
    collect_several(node, i, tick);
    return;
  }
  for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
    tac_packet *known = &channel->waiting[place];
    if (!channel->waits[place] || tick < data->lag || known->tick > tick - data->lag) {
      continue;
    }
    channel->waits[place] = false;
    if (known->tick == tick - data->lag) {
      packet = known;
      told = channel->tells_early[place];
    } else {
      miss(node, channel, known);
    }
  }
  if (packet != NULL) {
    node->counters.used++;
    if (data->acknowledged && data->kind == (uint8_t)TAC_DATA && !told) {
      channel->tells = 0U;
      tell(channel, packet->tick, 0U);
      node->marks[data->link].sent = tac_count_ticks(node);
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
    tac_degrade(node, tac_count_ticks(node));
  }
  channel->missing = missing;
  put_inputs(data, packet, node->inputs);
}
