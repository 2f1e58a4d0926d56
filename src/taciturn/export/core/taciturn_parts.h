/* taciturn: functions that the files of the core share. Not for programs. */
#ifndef TACITURN_PARTS_H
#define TACITURN_PARTS_H

#include "taciturn.h"

#define tac_count_ticks TAC_SIZED(tac_count_ticks)
#define tac_degrade TAC_SIZED(tac_degrade)
#define tac_collect TAC_SIZED(tac_collect)

#ifdef __cplusplus
extern "C" {
#endif

/* Return the number of steps that have begun. */
uint64_t tac_count_ticks(const tac_node *node);

/* Record an event that violates an assumption of the theory, after `ticks` steps have begun. */
void tac_degrade(tac_node *node, uint64_t ticks);

/* Copy the packet of channel `i` that a step reads to the inputs, and acknowledge the packet if it arrived in time. */
void tac_collect(tac_node *node, unsigned i, uint64_t tick);

#ifdef __cplusplus
}
#endif

#endif
