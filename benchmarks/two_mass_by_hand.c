/* The controller of two masses and a spring, written by hand in three ways, beside the step that is generated for it:
 * the instructions of a tick on a board, and whether the decisions agree. A, B, K (the filter's gain), L, and of the
 * trigger WEIGHT, PRICE and LEVEL stand in by_hand.h, which benchmarks/devices.py writes; the rows are those of the
 * self-check.
 *
 * Each takes the measurement and tells whether the command is to be sent:
 *
 *     estimate := prior + K (y - C prior);  command := L estimate
 *     send if PRICE (held - command)^2 - WEIGHT (|estimate|^2 + held^2) > LEVEL;  held := command where it is sent
 *     prior := A estimate + B held
 */
#include <stdio.h>

#include "by_hand.h"
#include "board.h"
#include "selfcheck.h"

enum { STATES = 4, OUTPUTS = 2, WAYS = 4 };

typedef struct {
  tac_real prior[STATES];
  tac_real held;
} memory;

/* As one writes it down: matrices and loops. */
static bool step_by_loops(memory *self, const tac_real *y, tac_real *command) {
  tac_real estimate[STATES];
  tac_real innovation[OUTPUTS];
  tac_real norm = self->held * self->held;
  tac_real u = 0;
  tac_real error;
  bool send;
  for (int i = 0; i < OUTPUTS; i++) {
    innovation[i] = y[i] - self->prior[i];
  }
  for (int i = 0; i < STATES; i++) {
    estimate[i] = self->prior[i];
    for (int j = 0; j < OUTPUTS; j++) {
      estimate[i] += K[i][j] * innovation[j];
    }
  }
  for (int i = 0; i < STATES; i++) {
    u += L[i] * estimate[i];
    norm += estimate[i] * estimate[i];
  }
  error = self->held - u;
  send = PRICE * error * error - WEIGHT * norm > LEVEL;
  if (send) {
    self->held = u;
    *command = u;
  }
  for (int i = 0; i < STATES; i++) {
    tac_real next = B[i] * self->held;
    for (int j = 0; j < STATES; j++) {
      next += A[i][j] * estimate[j];
    }
    self->prior[i] = next;
  }
  return send;
}

/* With the loops unrolled, numbers that are kept in registers, no product with 0 or 1, and a branch on the trigger: where
 * the command is sent, the next prior is (A + B L) estimate, without a product with the input. */
static bool step_by_hand(memory *self, const tac_real *y, tac_real *command) {
  const tac_real held = self->held;
  const tac_real d0 = y[0] - self->prior[0];
  const tac_real d1 = y[1] - self->prior[1];
  const tac_real x0 = self->prior[0] + (K[0][0] * d0 + K[0][1] * d1);
  const tac_real x1 = self->prior[1] + (K[1][0] * d0 + K[1][1] * d1);
  const tac_real x2 = self->prior[2] + (K[2][0] * d0 + K[2][1] * d1);
  const tac_real x3 = self->prior[3] + (K[3][0] * d0 + K[3][1] * d1);
  const tac_real u = L[0] * x0 + L[1] * x1 + L[2] * x2 + L[3] * x3;
  const tac_real error = held - u;
  const tac_real norm = x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 + held * held;
  if (PRICE * (error * error) - WEIGHT * norm > LEVEL) {
    self->prior[0] = CLOSED[0][0] * x0 + CLOSED[0][1] * x1 + CLOSED[0][2] * x2 + CLOSED[0][3] * x3;
    self->prior[1] = CLOSED[1][0] * x0 + CLOSED[1][1] * x1 + CLOSED[1][2] * x2 + CLOSED[1][3] * x3;
    self->prior[2] = CLOSED[2][0] * x0 + CLOSED[2][1] * x1 + CLOSED[2][2] * x2 + CLOSED[2][3] * x3;
    self->prior[3] = CLOSED[3][0] * x0 + CLOSED[3][1] * x1 + CLOSED[3][2] * x2 + CLOSED[3][3] * x3;
    self->held = u;
    *command = u;
    return true;
  }
  self->prior[0] = A[0][0] * x0 + A[0][1] * x1 + A[0][2] * x2 + A[0][3] * x3 + B[0] * held;
  self->prior[1] = A[1][0] * x0 + A[1][1] * x1 + A[1][2] * x2 + A[1][3] * x3 + B[1] * held;
  self->prior[2] = A[2][0] * x0 + A[2][1] * x1 + A[2][2] * x2 + A[2][3] * x3 + B[2] * held;
  self->prior[3] = A[3][0] * x0 + A[3][1] * x1 + A[3][2] * x2 + A[3][3] * x3 + B[3] * held;
  return false;
}

/* For two equal masses and no other plant: what pulls on one pulls back on the other, and so do the filter's gains. */
static bool step_by_symmetry(memory *self, const tac_real *y, tac_real *command) {
  const tac_real held = self->held;
  const tac_real d0 = y[0] - self->prior[0];
  const tac_real d1 = y[1] - self->prior[1];
  const tac_real x0 = self->prior[0] + (K[0][0] * d0 + K[0][1] * d1);
  const tac_real x1 = self->prior[1] + (K[0][1] * d0 + K[0][0] * d1);
  const tac_real x2 = self->prior[2] + (K[2][0] * d0 + K[2][1] * d1);
  const tac_real x3 = self->prior[3] + (K[2][1] * d0 + K[2][0] * d1);
  const tac_real u = L[0] * x0 + L[1] * x1 + L[2] * x2 + L[3] * x3;
  const tac_real error = held - u;
  const tac_real norm = x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 + held * held;
  const tac_real apart = x1 - x0;
  const tac_real leaving = x3 - x2;
  const tac_real moved = A[0][1] * apart + A[0][3] * leaving;
  const tac_real pulled = A[2][1] * apart + A[0][1] * leaving;
  const bool send = PRICE * (error * error) - WEIGHT * norm > LEVEL;
  const tac_real applied = send ? u : held;
  self->prior[0] = x0 + PERIOD * x2 + moved + B[0] * applied;
  self->prior[1] = x1 + PERIOD * x3 - moved + B[1] * applied;
  self->prior[2] = x2 + pulled + B[2] * applied;
  self->prior[3] = x3 - pulled + B[3] * applied;
  self->held = applied;
  *command = u;
  return send;
}

static bool do_nothing(memory *self, const tac_real *y, tac_real *command) {
  (void)self;
  (void)y;
  (void)command;
  return false;
}

typedef bool (*way)(memory *self, const tac_real *y, tac_real *command);

static void do_no_part(const tac_real *constants, const tac_real *inputs, tac_real *states, tac_real *outputs) {
  (void)constants;
  (void)inputs;
  (void)states;
  (void)outputs;
}

/* Return the instructions of a tick, those of a call that does nothing included. */
static __attribute__((noinline)) uint32_t count_way(way step, memory *own, const tac_real *y, tac_real *command,
                                                    bool *sent) {
  uint32_t before = board_now();
  bool found = step(own, y, command);
  uint32_t after = board_now();
  *sent = found;
  return board_instructions(before, after);
}

static __attribute__((noinline)) uint32_t count_part(tac_part *step, const tac_node *node, const tac_real *inputs) {
  uint32_t before = board_now();
  step(node->data->constants, inputs, node->memory, node->outputs);
  return board_instructions(before, board_now());
}

static const way ways[WAYS] = {do_nothing, step_by_loops, step_by_hand, step_by_symmetry};
static const char *const names[WAYS] = {"generated", "loops", "hand", "symmetry"};

int main(void) {
  static memory memories[WAYS];
  static uint64_t totals[WAYS];
  static uint32_t longest[WAYS];
  static unsigned differing[WAYS];
  const size_t width = selfcheck_measured + selfcheck_drawn + 2U * selfcheck_link_count + selfcheck_applied;
  tac_node *node = selfcheck_nodes[0].start();
  tac_real command = 0;
  bool sent;
  uint32_t around[2]; /* of a call that does nothing */
  board_start_timer();
  around[0] = count_part(do_no_part, node, selfcheck_vector);
  around[1] = count_way(do_nothing, &memories[0], selfcheck_vector, &command, &sent);
  for (size_t tick = 0U; tick < selfcheck_rows; tick++) {
    const tac_real *row = &selfcheck_vector[tick * width];
    const bool expected = row[selfcheck_measured + selfcheck_drawn + selfcheck_link_count] > 0;
    for (size_t i = 0U; i < selfcheck_measured; i++) { /* the outputs, then for each that it is measured */
      node->inputs[i] = row[i];
      node->inputs[selfcheck_measured + i] = 1;
    }
    for (size_t i = 0U; i < WAYS; i++) {
      uint32_t instructions;
      if (i == 0U) {
        instructions = count_part(node->data->first, node, node->inputs) - around[0];
        sent = node->outputs[node->data->sends[0].at] > 0;
      } else {
        instructions = count_way(ways[i], &memories[i], row, &command, &sent) - around[1];
      }
      totals[i] += instructions;
      longest[i] = (instructions > longest[i]) ? instructions : longest[i];
      differing[i] += (sent != expected) ? 1U : 0U;
    }
  }
  for (size_t i = 0U; i < WAYS; i++) {
    printf("%s %.0f %lu %u %lu\n", names[i], (double)totals[i], (unsigned long)longest[i], differing[i],
           (unsigned long)selfcheck_rows);
  }
  return 0;
}
