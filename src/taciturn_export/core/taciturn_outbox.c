/* taciturn: the packets that a node sends: data, acknowledgements and marks, with their sequence numbers. */
#include <string.h>

#include "taciturn_parts.h"

/* Begin a new epoch, in which all sequence numbers start at 0. */
static void begin_epoch(tac_node *node) {
  node->epoch++;
  for (unsigned i = 0U; i < node->data->send_count; i++) {
    node->sequences[i] = 0U;
  }
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    node->channels[i].told_sequence = 0U;
  }
  for (unsigned link = 0U; link < (unsigned)TAC_LINKS; link++) {
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
  size = tac_encode(&node->data->wire, node->keys[packet->link][0], packet, datagram);
  if (size == 0U) {
    node->counters.unsent++;
  }
  return size;
}

void tac_tell(const tac_node *node, unsigned i, unsigned place, tac_packet *packet) {
  packet->kind = (uint8_t)TAC_ACKNOWLEDGEMENT;
  packet->tick = node->channels[i].told[place];
  packet->entries = (node->data->channels[i].pieces > 0U) ? 1U : 0U;
  packet->values[0] = (tac_real)node->channels[i].after[place];
}

static size_t acknowledge(tac_node *node, unsigned i, uint8_t *datagram) {
  tac_channel *channel = &node->channels[i];
  tac_packet packet;
  (void)memset(&packet, 0, sizeof packet);
  packet.link = node->data->channels[i].link;
  channel->tells--;
  tac_tell(node, i, channel->tells, &packet);
  return hand_out(node, &packet, &channel->told_sequence, datagram);
}

bool tac_talks(const tac_node_data *data, uint8_t link, bool back) {
  bool found = false;
  for (unsigned i = 0U; !back && i < data->send_count; i++) {
    found = found || data->sends[i].link == link;
  }
  for (unsigned i = 0U; back && i < data->channel_count; i++) {
    found = found || (data->channels[i].acknowledged && data->channels[i].link == link);
  }
  return found;
}

/* Encode a mark if it is due on a link after the last step, and return its size, or 0. */
static size_t mark(tac_node *node, uint8_t link, uint8_t *datagram) {
  tac_marks *marks = &node->marks[link];
  uint64_t ticks = tac_count_ticks(node);
  bool back = !tac_talks(node->data, link, false);
  tac_packet packet;
  if (node->mark_after == TAC_NO_MARKS || !node->begun || marks->marked == ticks ||
      (back && !tac_talks(node->data, link, true)) ||
      (marks->sent > 0U && ticks - marks->sent < node->mark_after)) {
    return 0U;
  }
  marks->marked = ticks;
  marks->sent = ticks;
  (void)memset(&packet, 0, sizeof packet);
  packet.kind = (uint8_t)TAC_MARK;
  packet.back = back;
  packet.link = link;
  packet.entries = 0U;
  packet.tick = node->tick;
  return hand_out(node, &packet, &marks->sequence, datagram);
}

/* Write the next step and the newest packet of an operator, on channel `i`, into a packet for him. */
static void describe_newest(const tac_node *node, unsigned i, tac_packet *packet) {
  const tac_window *window = &node->channels[i].window;
  packet->tick = tac_count_ticks(node);
  packet->epoch = window->begun ? window->epoch : 0U;
  packet->sequence = window->begun ? window->newest : 0U;
}

/* Report to an operator: the set-points received and in effect, his newest packet, and the next step. */
static size_t report(tac_node *node, uint8_t *datagram) {
  unsigned i = tac_operator(node->data);
  uint8_t count = tac_set_point_count(node->data);
  tac_packet packet;
  (void)memset(&packet, 0, sizeof packet);
  packet.kind = (uint8_t)TAC_REPORT;
  packet.link = node->data->channels[i].link;
  packet.loop = node->loop;
  packet.entries = (uint8_t)(2U * count);
  describe_newest(node, i, &packet);
  for (unsigned k = 0U; k < count; k++) {
    packet.values[k] = node->inputs[node->data->channels[i].at + 1U + k];
  }
  (void)tac_setpoints(node, &packet.values[count]);
  node->reports = false;
  return tac_encode(&node->data->wire, node->keys[packet.link][0], &packet, datagram);
}

/* Tell an operator whether the operation is manual, and the manual inputs. */
static size_t tell_mode(tac_node *node, uint8_t *datagram) {
  unsigned i = tac_operator(node->data);
  uint8_t count = node->data->manual_count;
  tac_packet packet;
  (void)memset(&packet, 0, sizeof packet);
  packet.kind = (uint8_t)TAC_MODE;
  packet.link = node->data->channels[i].link;
  packet.loop = node->loop;
  packet.entries = (uint8_t)(count + 1U);
  describe_newest(node, i, &packet);
  for (unsigned k = 0U; k <= count; k++) {
    packet.values[k] = node->inputs[node->data->manual + k];
  }
  node->modes = false;
  return tac_encode(&node->data->wire, node->keys[packet.link][0], &packet, datagram);
}

size_t tac_send(tac_node *node, uint8_t *datagram) {
  size_t size = tac_send_proof(node, datagram);
  if (size == 0U && node->modes) {
    size = tell_mode(node, datagram);
  }
  if (size == 0U && node->reports) {
    size = report(node, datagram);
  }
  for (unsigned i = 0U; size == 0U && i < node->data->channel_count; i++) {
    if (node->channels[i].tells > 0U) {
      size = acknowledge(node, i, datagram);
    }
  }
  for (unsigned i = 0U; size == 0U && i < node->data->send_count; i++) {
    if ((node->pending & (UINT32_C(1) << i)) != 0U) {
      node->pending &= ~(UINT32_C(1) << i);
      size = hand_out(node, &node->sending[i], &node->sequences[i], datagram);
    }
  }
  for (unsigned link = 0U; size == 0U && link < (unsigned)TAC_LINKS; link++) {
    size = mark(node, (uint8_t)link, datagram);
  }
  return size;
}

void tac_mark_after(tac_node *node, uint32_t ticks) {
  node->mark_after = ticks;
}
