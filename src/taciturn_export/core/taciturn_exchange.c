/* taciturn: delivery of datagrams between the nodes of one process. */
#include "taciturn_exchange.h"
#include "taciturn_parts.h"

enum { KIND_AT = 5, LINK_AT = 6 }; /* positions of kind and link in a datagram */

/* Return the index of the node that receives packets of a kind on a link, or `count` if there is none. `pieces` is set
 * to the number of pieces of a step in which it hears them. */
static size_t find_listener(const tac_exchange *exchange, unsigned kind, unsigned link, unsigned *pieces) {
  *pieces = 1U;
  for (size_t i = 0U; i < exchange->count; i++) {
    const tac_node_data *data = exchange->nodes[i]->data;
    for (unsigned c = 0U; c < data->channel_count; c++) {
      if (data->channels[c].kind == kind && data->channels[c].link == link) {
        *pieces = (data->channels[c].pieces > 0U) ? data->channels[c].pieces : 1U;
        return i;
      }
    }
  }
  return exchange->count;
}

/* Deliver the packets of a node unless they are dropped, and set the used links in `sent`. False: a box is full. */
static bool deliver(tac_exchange *exchange, tac_node *node, const bool *lost, const uint16_t *late, bool *sent) {
  tac_datagram next;
  while ((next.size = tac_send(node, next.bytes)) > 0U) {
    unsigned kind = next.bytes[KIND_AT];
    unsigned link = next.bytes[LINK_AT];
    unsigned pieces;
    size_t to = find_listener(exchange, kind, link, &pieces);
    bool data = kind == (unsigned)TAC_DATA && link < (unsigned)TAC_LINKS;
    unsigned after = (data && late != NULL) ? late[link] : 0U;
    if (data) {
      sent[link] = true;
    }
    if (to == exchange->count || (data && lost[link])) {
      continue;
    }
    if (exchange->waiting[to] == (size_t)TAC_BOX) {
      return false;
    }
    next.due = node->tick + (after / pieces);
    next.piece = (uint8_t)(after % pieces);
    exchange->boxes[to][exchange->waiting[to]] = next;
    exchange->waiting[to]++;
  }
  return true;
}

/* Give a node the datagrams that arrive in a step; the others stay. */
static void receive_due(tac_exchange *exchange, size_t i, uint64_t tick) {
  size_t kept = 0U;
  for (size_t k = 0U; k < exchange->waiting[i]; k++) {
    const tac_datagram *next = &exchange->boxes[i][k];
    if (next->due > tick) {
      exchange->boxes[i][kept] = *next;
      kept++;
    } else {
      (void)tac_receive_in(exchange->nodes[i], next->bytes, next->size, next->piece);
    }
  }
  exchange->waiting[i] = kept;
}

/* Return whether a node has a key of any link. */
static bool has_key(const tac_node *node) {
  bool found = false;
  for (size_t link = 0U; link < (size_t)TAC_LINKS; link++) {
    found = found || node->keys[link][0].bytes != NULL;
  }
  return found;
}

size_t tac_exchange_step(tac_exchange *exchange, uint64_t tick, const tac_real *measurement, const tac_real *drawn,
                         const bool *lost, const uint16_t *late, bool *sent) {
  size_t measured = 0U;
  size_t i = 0U;
  for (size_t link = 0U; link < (size_t)TAC_LINKS; link++) {
    sent[link] = false;
  }
  for (; i < exchange->count; i++) {
    tac_node *node = exchange->nodes[i];
    size_t given = tac_set_point_count(node->data);
    if (has_key(node)) {
      break; /* nobody can read or change what one process keeps, and challenges would take further steps */
    }
    receive_due(exchange, i, tick);
    if (given > 0U && !tac_setpoint(node, &measurement[measured + node->data->measurement_count])) {
      break;
    }
    if (!tac_step(node, tick, &measurement[measured], (node->data->drawn_count > 0U) ? drawn : NULL) ||
        !deliver(exchange, node, lost, late, sent)) {
      break;
    }
    measured += node->data->measurement_count;
    measured += given;
  }
  return i;
}

void tac_exchange_inputs(const tac_exchange *exchange, tac_real *inputs) {
  size_t at = 0U;
  for (size_t i = 0U; i < exchange->count; i++) {
    const tac_real *input = tac_input(exchange->nodes[i]);
    for (size_t k = 0U; input != NULL && k < exchange->nodes[i]->data->applied_count; k++) {
      inputs[at] = input[k];
      at++;
    }
  }
}

bool tac_exchange_degraded(const tac_exchange *exchange) {
  bool degraded = false;
  for (size_t i = 0U; i < exchange->count; i++) {
    degraded = degraded || tac_degraded(exchange->nodes[i]);
  }
  return degraded;
}
