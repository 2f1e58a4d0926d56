/* taciturn: the beginning of steps, estimated from arriving packets by the rule of nodes on a host. */
#include <string.h>

#include "taciturn_parts.h"

enum { PER_DRIFT = 1000 };       /* the largest difference in speed of two clocks is 1 / PER_DRIFT */
enum { JUMPED = 16, AGREED = 8 }; /* steps beyond which the time has jumped, and packets that must agree on a jump */
enum { LATE = 4 };               /* a packet is late if it is more than 1 / LATE of a step late */
enum { SPAN = 8192 };            /* least number of steps over which the drift is measured, if so many have passed */
#define MILLION INT64_C(1000000)

/* Return the difference of two readings of the timer, of which either may be the later. */
static int64_t between(uint64_t early, uint64_t late) {
  uint64_t ahead = late - early;
  uint64_t behind = early - late - 1U;
  return (ahead <= (uint64_t)INT64_MAX) ? (int64_t)ahead : (-(int64_t)behind - 1);
}

static bool is_far(const tac_clock *clock, int64_t off) {
  int64_t far = (int64_t)JUMPED * (int64_t)clock->period;
  return off > far || off < -far;
}

/* Begin the measurement of offset and drift in a step. */
static void begin_at(tac_clock *clock, uint64_t tick, uint64_t zero) {
  clock->known = true;
  clock->zero = zero;
  clock->last = tick;
  clock->agreed = 0U;
  for (unsigned i = 0U; i < 2U; i++) {
    clock->ticks[i] = tick;
    clock->zeros[i] = zero;
  }
}

/* Return whether a packet far from the estimate is believed: eight in a row that agree move the estimate. */
static bool follow_jump(tac_clock *clock, uint64_t tick, uint64_t found) {
  bool agrees = clock->agreed > 0U && !is_far(clock, between(clock->jump, found));
  bool late = between(clock->zero, found) > 0;
  clock->jump = found;
  clock->agreed = agrees ? (clock->agreed + 1U) : 1U;
  if (clock->agreed < (uint32_t)AGREED) {
    return late;
  }
  begin_at(clock, tick, found);
  clock->jumps++;
  return true;
}

/* Move the estimate if the last packets were all late, so that it was too early for each of them. */
static void follow_late(tac_clock *clock, int64_t off) {
  uint32_t most = clock->period / (uint32_t)LATE;
  bool late = off > (int64_t)most;
  clock->late = late ? (clock->late + 1U) : 0U;
  if (clock->late == 1U || (late && off < clock->least)) {
    clock->least = off;
  }
  if (clock->late == (uint32_t)AGREED) {
    clock->jumps += (clock->least >= (int64_t)clock->period) ? 1U : 0U;
    clock->zero += (uint64_t)clock->least;
    for (unsigned i = 0U; i < 2U; i++) {
      clock->zeros[i] += (uint64_t)clock->least; /* this is no drift */
    }
    clock->late = 0U;
  }
}

void tac_clock_start(tac_clock *clock, uint32_t period) {
  (void)memset(clock, 0, sizeof *clock);
  clock->period = period;
}

bool tac_clock_hear(tac_clock *clock, uint64_t tick, uint64_t now) {
  uint64_t found = now - (tick * clock->period);
  int64_t off = between(clock->zero, found);
  if (!clock->known) {
    clock->first = found;
    begin_at(clock, tick, found);
    return true;
  }
  if (is_far(clock, off)) {
    return follow_jump(clock, tick, found);
  }
  clock->agreed = 0U;
  if (off < 0) {
    clock->zero = found;
  } else if (tick > clock->last) {
    uint64_t most = ((tick - clock->last) * clock->period) / (uint64_t)PER_DRIFT;
    if (most == 0U) {
      follow_late(clock, off);
      return true; /* less than a count of the timer: later packets add up */
    }
    clock->zero += ((uint64_t)off < most) ? (uint64_t)off : most;
  } else {
    /* a packet of an earlier step that came late tells nothing */
  }
  if (tick > clock->last) {
    clock->last = tick;
  }
  if (tick > clock->ticks[1] && tick - clock->ticks[1] >= (uint64_t)SPAN) {
    clock->ticks[0] = clock->ticks[1];
    clock->zeros[0] = clock->zeros[1];
    clock->ticks[1] = tick;
    clock->zeros[1] = clock->zero;
  }
  follow_late(clock, off);
  return true;
}

bool tac_clock_receive(tac_clock *clock, tac_node *node, const uint8_t *datagram, size_t size, uint64_t now) {
  bool usable;
  node->dated = 0U;
  usable = tac_receive(node, datagram, size);
  if (node->dated > 0U) {
    (void)tac_clock_hear(clock, node->dated - 1U, now);
  }
  return usable;
}

uint64_t tac_clock_due(const tac_clock *clock, uint64_t now) {
  uint64_t begins = clock->zero; /* the first step that this clock can have begun is 0 */
  int64_t since = between(begins, now);
  return (clock->known && since >= 0) ? (((uint64_t)since / clock->period) + 1U) : 0U;
}

int64_t tac_clock_offset(const tac_clock *clock) {
  return between(clock->first, clock->zero);
}

int32_t tac_clock_drift(const tac_clock *clock) {
  uint64_t span = (clock->last - clock->ticks[0]) * clock->period;
  int64_t moved = between(clock->zeros[0], clock->zero);
  return (span == 0U) ? 0 : (int32_t)((moved * MILLION) / (int64_t)span);
}
