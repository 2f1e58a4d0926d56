/* taciturn: the beginning of steps, estimated from arriving packets. Included by taciturn.h. */
#ifndef TACITURN_CLOCK_H
#define TACITURN_CLOCK_H

#include "taciturn.h"

#define tac_clock_start TAC_SIZED(tac_clock_start)
#define tac_clock_hear TAC_SIZED(tac_clock_hear)
#define tac_clock_receive TAC_SIZED(tac_clock_receive)
#define tac_clock_due TAC_SIZED(tac_clock_due)
#define tac_clock_offset TAC_SIZED(tac_clock_offset)
#define tac_clock_drift TAC_SIZED(tac_clock_drift)

#ifdef __cplusplus
extern "C" {
#endif

/* An estimate of the beginning of steps by the readings of a timer, from the packets of the node that sets the time. It
 * needs no synchronised clocks: the timer may run up to 0.1 % faster or slower. A packet may be late but not early, so
 * the earliest packets determine the estimate. */
typedef struct {
  uint64_t zero;     /* reading at which step 0 began, modulo 2^64 */
  uint64_t first;    /* its first estimate */
  uint64_t last;     /* newest step of a packet */
  uint64_t jump;     /* reading at which step 0 began, if the time has jumped */
  uint64_t ticks[2]; /* steps from which the drift is measured, and the estimates then */
  uint64_t zeros[2];
  int64_t least;   /* least offset of the last packets, if all of them were late */
  uint32_t period; /* counts of the timer in a step */
  uint32_t agreed; /* consecutive packets that agree on a jump */
  uint32_t late;   /* consecutive late packets */
  uint32_t jumps;  /* jumps so far */
  bool known;      /* whether a packet has arrived */
} tac_clock;

/* Initialize a clock. `period` is the length of a step in counts of the timer, from 1; use a timer with 1000 or more
 * counts in a step. */
void tac_clock_start(tac_clock *clock, uint32_t period);

/* Process a datagram as `tac_receive` does, and update the clock if it contains new data or a new mark. `now` is the
 * reading of the timer at its arrival; readings have 64 bits and do not go back. */
bool tac_clock_receive(tac_clock *clock, tac_node *node, const uint8_t *datagram, size_t size, uint64_t now);

/* Update a clock with a packet of step `tick` that arrived at the reading `now`. An estimate that differs by more than
 * 16 steps is a jump, which is followed after 8 consecutive packets that agree. Return false if the step of the packet
 * cannot have begun. */
bool tac_clock_hear(tac_clock *clock, uint64_t tick, uint64_t now);

/* Return the number of the newest step that has begun at the reading `now`, plus one; 0: none, or unknown. For a node
 * that waits for the packets of a step, subtract the waiting time, for example half a step, from the reading. */
uint64_t tac_clock_due(const tac_clock *clock, uint64_t now);

/* Return by how many counts the timer has advanced more than the steps have, since the first packet. */
int64_t tac_clock_offset(const tac_clock *clock);

/* Return by how many parts per million the timer is faster than the steps, over the last 8192 to 16384 steps. The error
 * is about the jitter of the packets, divided by that time. */
int32_t tac_clock_drift(const tac_clock *clock);

#ifdef __cplusplus
}
#endif

#endif
