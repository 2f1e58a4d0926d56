/* taciturn: the nodes of one policy in one process, with links between them that deliver or drop packets. For the
 * self-check and for simulators; nodes on separate devices use a network instead. */
#ifndef TACITURN_EXCHANGE_H
#define TACITURN_EXCHANGE_H

#include "taciturn.h"

enum { TAC_NODES = TAC_LINKS + 1, TAC_BOX = (2 * TAC_LINKS * (1 + TAC_WAITING)) + 4 };
/* numbers of nodes, and of datagrams that wait for a node, or are on their way to it */

typedef struct {
  uint8_t bytes[TAC_DATAGRAM];
  size_t size;
  uint64_t due; /* step in which it arrives */
  uint8_t piece; /* and piece of this step */
} tac_datagram;

/* The nodes and their waiting datagrams. Initialize all bytes with 0, and set started nodes in the order of a step. */
typedef struct {
  tac_node *nodes[TAC_NODES];
  size_t count; /* number of nodes */
  tac_datagram boxes[TAC_NODES][TAC_BOX];
  size_t waiting[TAC_NODES]; /* number of datagrams in each box */
} tac_exchange;

/* Execute a step of nodes, which have no keys, as nobody else can reach the nodes of one process: each node in turn
 * receives its datagrams, steps, and sends. `measurement` holds those of all nodes, in the order of the nodes, each
 * with the set-points that the node is given. `drawn` replaces the random draws of the nodes, unless it is NULL. For
 * each link, `lost` is whether a packet sent in this step is dropped, and `late` after how many pieces of a step it
 * arrives on a link that delays packets at random; NULL: none is delayed. `sent` is set to whether a packet was sent.
 * Return the index of the node that did not execute the step, or `count` if all did. */
size_t tac_exchange_step(tac_exchange *exchange, uint64_t tick, const tac_real *measurement, const tac_real *drawn,
                         const bool *lost, const uint16_t *late, bool *sent);

/* Write the inputs of the plant from all nodes that apply some, in the order of the nodes. */
void tac_exchange_inputs(const tac_exchange *exchange, tac_real *inputs);

/* Return whether any node is degraded. */
bool tac_exchange_degraded(const tac_exchange *exchange);

#endif
