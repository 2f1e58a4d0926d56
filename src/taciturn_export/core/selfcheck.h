/* taciturn: declarations of the data of the self-check, which are generated. Not for a device. */
#ifndef TACITURN_SELFCHECK_H
#define TACITURN_SELFCHECK_H

#include "taciturn.h"

typedef struct {
  const char *name;
  tac_node *(*start)(void);
} selfcheck_node;

extern const char selfcheck_name[];
extern const selfcheck_node selfcheck_nodes[]; /* in the order of a step */
extern const size_t selfcheck_node_count;      /* at most 3 */
extern const uint8_t selfcheck_links[];        /* links on which packets are sent */
extern const size_t selfcheck_link_count;      /* at most 2 */
extern const size_t selfcheck_measured;        /* numbers in a row: measurements, */
extern const size_t selfcheck_drawn;           /* random draws, */
extern const size_t selfcheck_applied;         /* and expected inputs; before the inputs, for each link, 1 if packets */
                                               /* are delivered, and 1 if a packet is expected to be sent */
extern const size_t selfcheck_rows;
extern const tac_real selfcheck_vector[];

#endif
