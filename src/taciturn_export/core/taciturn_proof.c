/* taciturn: proofs that senders are running, so that packets that were recorded before are useless. With a key, a node
 * challenges the sender of an epoch that has no proof. The sender answers, and sends its last packets again. */
#include <string.h>

#include "taciturn_parts.h"

enum { VALID = 2 }; /* last steps whose packets are valid after an answer */
enum { NONE, MARK, DATA, TOLD }; /* kinds of packets to send again after an answer: this one, and those before it */
enum { SEED_SIZE = 11 };

static uint64_t nonce_of(const tac_node *node, unsigned i) {
  uint8_t link = node->data->channels[i].link;
  uint8_t seed[SEED_SIZE];
  tac_put(seed, node->epoch, 4U);
  tac_put(&seed[4], node->loop, 2U);
  seed[6] = link;
  tac_put(&seed[7], node->channels[i].challenge, 4U);
  return tac_draw(node->keys[link][0], seed, sizeof seed);
}

/* Return whether the packets of a channel travel against their link. */
static bool comes_back(const tac_channel_data *channel) {
  return channel->kind == (uint8_t)TAC_ACKNOWLEDGEMENT;
}

bool tac_is_admitted(tac_node *node, unsigned i, const tac_packet *packet) {
  tac_channel *channel = &node->channels[i];
  bool known = channel->has_proof && packet->epoch == channel->proven;
  if (node->keys[packet->link][0].bytes == NULL || (known && packet->tick >= channel->first)) {
    return true;
  }
  node->counters.unproven++;
  if (!known) {
    if (!channel->challenged) {
      channel->challenged = true;
      channel->challenge = node->challenges;
      node->challenges++;
    }
    channel->challenges = true;
  }
  return false;
}

/* Store the proof in an answer to the open challenge of a channel. */
static void accept_answer(tac_node *node, unsigned i, const tac_packet *packet) {
  tac_channel *channel = &node->channels[i];
  if (!channel->challenged || packet->nonce != nonce_of(node, i)) {
    return;
  }
  if (!channel->has_proof || packet->epoch != channel->proven) {
    tac_forget_numbered(node, i);
    (void)memset(&channel->window, 0, sizeof channel->window);
    (void)memset(&channel->marks, 0, sizeof channel->marks);
    channel->missing = 0U;
    channel->marked = 0U;
  }
  channel->has_proof = true;
  channel->proven = packet->epoch;
  channel->first = packet->tick;
  channel->challenged = false;
  channel->challenges = false;
}

/* Answer the challenge of an operator, and report to him. Return false if it is another challenge. */
static bool greet(tac_node *node, const tac_packet *packet) {
  unsigned i = tac_operator(node->data);
  if (packet->kind != (uint8_t)TAC_CHALLENGE || packet->back || packet->loop != node->loop ||
      i == node->data->channel_count || node->data->channels[i].link != packet->link) {
    return false;
  }
  node->proofs[packet->link].nonce = packet->nonce;
  node->proofs[packet->link].answers = true;
  tac_report(node);
  return true;
}

void tac_take_proof(tac_node *node, const tac_packet *packet) {
  node->counters.proofs++;
  if (greet(node, packet)) {
    return;
  }
  if (packet->loop != node->loop || packet->link >= (uint8_t)TAC_LINKS ||
      node->keys[packet->link][0].bytes == NULL) {
    return;
  }
  if (packet->kind == (uint8_t)TAC_ANSWER) {
    for (unsigned i = 0U; i < node->data->channel_count; i++) {
      if (node->data->channels[i].link == packet->link && comes_back(&node->data->channels[i]) == packet->back) {
        accept_answer(node, i, packet);
      }
    }
  } else if (tac_talks(node->data, packet->link, !packet->back)) {
    tac_proof *proof = &node->proofs[packet->link];
    uint64_t ticks = tac_count_ticks(node);
    proof->nonce = packet->nonce;
    proof->answers = true;
    if (node->begun && proof->repeated != ticks) {
      proof->repeated = ticks;
      proof->again = (uint8_t)TOLD;
    }
  } else {
    /* a challenge of what this node does not send */
  }
}

static size_t write_packet(tac_node *node, tac_packet *packet, uint8_t link, uint8_t *datagram) {
  packet->link = link;
  packet->loop = node->loop;
  return tac_encode(&node->data->wire, node->keys[link][0], packet, datagram);
}

static size_t send_challenge(tac_node *node, unsigned i, uint8_t *datagram) {
  const tac_channel_data *data = &node->data->channels[i];
  tac_packet packet;
  (void)memset(&packet, 0, sizeof packet);
  packet.kind = (uint8_t)TAC_CHALLENGE;
  packet.back = !comes_back(data);
  packet.nonce = nonce_of(node, i);
  node->channels[i].challenges = false;
  return write_packet(node, &packet, data->link, datagram);
}

static size_t send_answer(tac_node *node, uint8_t link, uint8_t *datagram) {
  uint64_t ticks = tac_count_ticks(node);
  unsigned own = tac_operator(node->data);
  tac_packet packet;
  (void)memset(&packet, 0, sizeof packet);
  packet.kind = (uint8_t)TAC_ANSWER;
  packet.back = !tac_talks(node->data, link, false);
  packet.nonce = node->proofs[link].nonce;
  packet.epoch = node->epoch;
  if (own < node->data->channel_count && node->data->channels[own].link == link) { /* the last one of an operator */
    packet.epoch = node->channels[own].window.begun ? node->channels[own].window.epoch : 0U;
  }
  packet.tick = (ticks > (uint64_t)VALID) ? (ticks - (uint64_t)VALID) : 0U;
  return write_packet(node, &packet, link, datagram);
}

static bool is_valid(const tac_node *node, uint64_t tick) {
  return tick + (uint64_t)VALID > node->tick;
}

/* Send the last acknowledgement or the last mark on a link again. */
static size_t send_again(tac_node *node, uint8_t link, tac_packet *packet, uint32_t following, uint8_t *datagram) {
  packet->epoch = node->epoch;
  if (following == 0U || !is_valid(node, packet->tick)) {
    return 0U;
  }
  packet->sequence = following - 1U;
  return write_packet(node, packet, link, datagram);
}

static size_t send_told_again(tac_node *node, uint8_t link, uint8_t *datagram) {
  size_t size = 0U;
  for (unsigned i = 0U; size == 0U && i < node->data->channel_count; i++) {
    const tac_channel *channel = &node->channels[i];
    if (node->data->channels[i].link == link && node->data->channels[i].acknowledged && (channel->tells == 0U)) {
      tac_packet packet;
      (void)memset(&packet, 0, sizeof packet);
      tac_tell(node, i, 0U, &packet); /* sent last */
      size = send_again(node, link, &packet, channel->told_sequence, datagram);
    }
  }
  return size;
}

static size_t send_data_again(tac_node *node, uint8_t link, uint8_t *datagram) {
  size_t size = 0U;
  for (unsigned i = 0U; size == 0U && i < node->data->send_count; i++) {
    tac_packet *packet = &node->sending[i];
    bool sent = node->sequences[i] > 0U && (node->pending & (UINT32_C(1) << i)) == 0U;
    if (node->data->sends[i].link == link && sent && is_valid(node, packet->tick)) {
      size = write_packet(node, packet, link, datagram);
    }
  }
  return size;
}

static size_t send_mark_again(tac_node *node, uint8_t link, uint8_t *datagram) {
  const tac_marks *marks = &node->marks[link];
  tac_packet packet;
  (void)memset(&packet, 0, sizeof packet);
  packet.kind = (uint8_t)TAC_MARK;
  packet.back = !tac_talks(node->data, link, false);
  packet.tick = marks->marked - 1U;
  return (marks->marked == 0U) ? 0U : send_again(node, link, &packet, marks->sequence, datagram);
}

/* Write the next datagram of the proof on a link. */
static size_t send_next(tac_node *node, uint8_t link, uint8_t *datagram) {
  tac_proof *proof = &node->proofs[link];
  size_t size = 0U;
  if (proof->answers) {
    proof->answers = false;
    return send_answer(node, link, datagram);
  }
  for (; size == 0U && proof->again != (uint8_t)NONE; proof->again--) {
    if (proof->again == (uint8_t)TOLD) {
      size = send_told_again(node, link, datagram);
    } else if (proof->again == (uint8_t)DATA) {
      size = send_data_again(node, link, datagram);
    } else {
      size = send_mark_again(node, link, datagram);
    }
  }
  return size;
}

size_t tac_send_proof(tac_node *node, uint8_t *datagram) {
  size_t size = 0U;
  for (unsigned link = 0U; size == 0U && link < (unsigned)TAC_LINKS; link++) {
    size = send_next(node, (uint8_t)link, datagram);
  }
  for (unsigned i = 0U; size == 0U && i < node->data->channel_count; i++) {
    if (node->channels[i].challenges) {
      size = send_challenge(node, i, datagram);
    }
  }
  return size;
}
