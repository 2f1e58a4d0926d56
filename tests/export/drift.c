/* A controller sets the time, and an actuator with a timer of its own follows it for simulated seconds: `drift`.
 *
 * For each drift of the timer one line: drift, steps that the actuator has executed late (missed), step that it has
 * executed last, least and largest time in microseconds from the end of its waiting to its step, and what it tells of
 * drift and offset. Once, the actuator stalls for ten steps, and what arrives then is lost. */
#include <stdio.h>

#include "policy_actuator.h"
#include "policy_controller.h"

enum { PERIOD = 10000, WAIT = PERIOD / 2, POLL = 1000, BOX = 8, STALL = 10, MARKS = 5 }; /* microseconds; steps */

typedef struct {
  uint8_t bytes[TAC_DATAGRAM];
  size_t size;
  uint64_t arrives;
} mail;

static policy_controller memory;
static policy_actuator listener;
static mail box[BOX];
static size_t waiting;
static uint64_t word = 88172645463325252U;

static uint64_t draw(void) {
  word ^= word << 13U;
  word ^= word >> 7U;
  word ^= word << 17U;
  return word >> 16U;
}

/* The timer of the actuator: it began with another reading, and runs at another speed. */
static uint64_t timer(uint64_t time, int64_t ppm) {
  return UINT64_C(123456789) + (uint64_t)((int64_t)time + (((int64_t)time * ppm) / 1000000));
}

static void speak(tac_node *node, uint64_t tick) {
  tac_real y[2];
  for (unsigned i = 0U; i < 2U; i++) {
    y[i] = (tac_real)((double)(draw() % 2000U) / 1000.0 - 1.0);
  }
  (void)tac_step(node, tick, y, NULL);
  while (waiting < (size_t)BOX && (box[waiting].size = tac_send(node, box[waiting].bytes)) > 0U) {
    uint64_t late = draw() % 3000U; /* mostly soon, sometimes late */
    box[waiting].arrives = (tick * PERIOD) + 200U + ((late * late) / 3000U);
    waiting++;
  }
}

static void hear(tac_clock *clock, tac_node *node, uint64_t time, int64_t ppm, bool stalled) {
  size_t left = 0U;
  for (size_t i = 0U; i < waiting; i++) {
    if (box[i].arrives > time) {
      box[left] = box[i];
      left++;
    } else if (!stalled) {
      (void)tac_clock_receive(clock, node, box[i].bytes, box[i].size, timer(time, ppm));
    } else {
      /* lost */
    }
  }
  waiting = left;
}

static bool run(int64_t ppm, uint64_t seconds) {
  const tac_key none = {NULL, 0U};
  tac_node *sender = policy_controller_start(&memory, 1U, 0U, none);
  tac_node *node = policy_actuator_start(&listener, 1U, 0U, none);
  uint64_t steps = (seconds * 1000000U) / PERIOD;
  uint64_t next = 0U;
  int64_t least = INT64_MAX;
  int64_t most = INT64_MIN;
  tac_clock clock;
  if (sender == NULL || node == NULL) {
    return false;
  }
  tac_clock_start(&clock, PERIOD);
  tac_mark_after(sender, MARKS);
  for (uint64_t tick = 0U; tick < steps; tick++) {
    bool stalled = tick >= steps / 2U && tick < (steps / 2U) + STALL;
    speak(sender, tick);
    for (uint64_t time = tick * PERIOD; time < (tick + 1U) * PERIOD; time += POLL) {
      uint64_t due;
      hear(&clock, node, time, ppm, stalled);
      due = stalled ? 0U : tac_clock_due(&clock, timer(time, ppm) - WAIT);
      if (due > next) {
        int64_t after = (int64_t)time - (int64_t)(((due - 1U) * PERIOD) + WAIT);
        bool woken = tick == (steps / 2U) + STALL && due > next + 1U;
        if (!tac_step(node, due - 1U, NULL, NULL)) {
          return false;
        }
        least = (after < least) ? after : least;
        most = (after > most && !woken) ? after : most;
        next = due;
      }
    }
  }
  (void)printf("%ld %lu %lu %ld %ld %ld %ld\n", (long)ppm, (unsigned long)node->counters.missed,
               (unsigned long)node->tick, (long)least, (long)most, (long)tac_clock_drift(&clock),
               (long)tac_clock_offset(&clock));
  return clock.jumps == 0U;
}

int main(void) {
  return (run(500, DRIFT_SECONDS) && run(-500, DRIFT_SECONDS)) ? 0 : 1;
}
