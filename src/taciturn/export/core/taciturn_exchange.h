/* taciturn: the nodes of one policy in one process: what each of them sends is carried to who listens, or lost. For the
 * self-check and for simulators; nodes on devices of their own have a network for it. */
#ifndef TACITURN_EXCHANGE_H
#define TACITURN_EXCHANGE_H

#include "taciturn.h"

enum { TAC_NODES = 3, TAC_LINKS = 2, TAC_BOX = 8 }; /* nodes, links between them, datagrams on their way to a node */

typedef struct {
  uint8_t bytes[TAC_DATAGRAM];
  size_t size;
} tac_datagram;

/* To begin, set all bytes to 0, and the nodes, which have been started, in the order of a tick. */
typedef struct {
  tac_node *nodes[TAC_NODES];
  size_t count; /* of them */
  tac_datagram boxes[TAC_NODES][TAC_BOX];
  size_t waiting[TAC_NODES]; /* datagrams in each box */
} tac_exchange;

/* Go through a tick: each node in turn takes what has come to it, steps, and sends. `drawn` replaces the draws of the
 * nodes; NULL: they draw. For each link, `lost` tells whether a packet is lost that is sent in this tick, and `sent` is
 * set to whether one was. Return which node did not go on; `count`: all did. */
size_t tac_exchange_step(tac_exchange *exchange, uint64_t tick, const tac_real *measurement, const tac_real *drawn,
                         const bool *lost, bool *sent);

/* Return the input of the plant: that of the node that has it; NULL: none has. */
const tac_real *tac_exchange_input(const tac_exchange *exchange);

/* Whether any of the nodes is degraded. */
bool tac_exchange_degraded(const tac_exchange *exchange);

#endif
