/* Measurement of the instructions of each step of each node during the self-check, printed if the self-check passes.
 *
 * With the linker option --wrap, functions with the prefix __wrap_ replace functions of the core and `main`. The
 * original `main` is the self-check, with rows that are compiled in or rows of a file.
 */
#include <stdio.h>

#include "board.h"
#include "selfcheck.h"

#define __real_tac_receive TAC_SIZED(__real_tac_receive)
#define __real_tac_step TAC_SIZED(__real_tac_step)
#define __real_tac_send TAC_SIZED(__real_tac_send)
#define __wrap_tac_receive TAC_SIZED(__wrap_tac_receive)
#define __wrap_tac_step TAC_SIZED(__wrap_tac_step)
#define __wrap_tac_send TAC_SIZED(__wrap_tac_send)

enum { NODES = 3, TURNS = 1000, PER_TURN = 2 }; /* TURNS, PER_TURN: loop of known length */

extern int __real_main(int count, char **arguments);
extern bool __real_tac_receive(tac_node *node, const uint8_t *datagram, size_t size);
extern bool __real_tac_step(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn);
extern size_t __real_tac_send(tac_node *node, uint8_t *datagram);
int __wrap_main(int count, char **arguments);
bool __wrap_tac_receive(tac_node *node, const uint8_t *datagram, size_t size);
bool __wrap_tac_step(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn);
size_t __wrap_tac_send(tac_node *node, uint8_t *datagram);

typedef struct {
  uint64_t total;
  uint32_t longest;
} tally;

/* The instruction counts of a node: for its generated code, for tac_step, and for all its functions in a step. */
typedef struct {
  const tac_node *node;
  const tac_node_data *data; /* original data */
  tac_node_data timed;       /* the same data with timed functions */
  tally step, tick, all;
  uint32_t ticks;
  uint32_t open; /* instructions of the current step so far */
  bool stepped;  /* whether tac_step was called in this step */
} count;

static count counts[NODES];
static size_t nodes;
static const tac_node_data *current; /* data of the node that executes a step */
static volatile uint32_t begun[2], ended[2];
static uint32_t around;      /* instructions between the readings for an empty function */
static uint32_t around_part; /* instructions that the timing of one function adds to tac_step */

static void time_first(const tac_real *constants, const tac_real *inputs, tac_real *memory, tac_real *outputs) {
  tac_part *const run = current->first;
  begun[0] = board_now();
  run(constants, inputs, memory, outputs);
  ended[0] = board_now();
}

static void time_second(const tac_real *constants, const tac_real *inputs, tac_real *memory, tac_real *outputs) {
  tac_part *const run = current->second;
  begun[1] = board_now();
  run(constants, inputs, memory, outputs);
  ended[1] = board_now();
}

static void add(tally *to, uint32_t instructions) {
  to->total += instructions;
  if (instructions > to->longest) {
    to->longest = instructions;
  }
}

static void close_tick(count *of) {
  if (of->stepped) {
    add(&of->all, of->open);
    of->open = 0U;
    of->stepped = false;
  }
}

static count *find(const tac_node *node) {
  size_t i = 0U;
  while (i < nodes && counts[i].node != node) {
    i++;
  }
  if (i == nodes) {
    counts[i].node = node;
    counts[i].data = node->data;
    counts[i].timed = *node->data;
    counts[i].timed.first = time_first;
    counts[i].timed.second = (node->data->second == NULL) ? NULL : time_second;
    nodes++;
  }
  return &counts[i];
}

bool __wrap_tac_receive(tac_node *node, const uint8_t *datagram, size_t size) {
  count *of = find(node);
  uint32_t before;
  uint32_t after;
  bool taken;
  close_tick(of);
  before = board_now();
  taken = __real_tac_receive(node, datagram, size);
  after = board_now();
  of->open += board_instructions(before, after) - around;
  return taken;
}

bool __wrap_tac_step(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn) {
  count *of = find(node);
  uint32_t before;
  uint32_t after;
  uint32_t instructions;
  uint32_t parts = 0U;
  uint32_t calls = 0U;
  bool gone;
  close_tick(of);
  for (unsigned i = 0U; i < 2U; i++) {
    begun[i] = 0U;
    ended[i] = 0U;
  }
  current = of->data;
  node->data = &of->timed;
  before = board_now();
  gone = __real_tac_step(node, tick, measurement, drawn);
  after = board_now();
  node->data = of->data;
  for (unsigned i = 0U; i < 2U; i++) {
    if (begun[i] != ended[i]) {
      parts += board_instructions(begun[i], ended[i]) - around;
      calls++;
    }
  }
  instructions = board_instructions(before, after) - around - calls * around_part;
  add(&of->step, parts);
  add(&of->tick, instructions);
  of->open += instructions;
  of->ticks++;
  of->stepped = true;
  return gone;
}

size_t __wrap_tac_send(tac_node *node, uint8_t *datagram) {
  count *of = find(node);
  uint32_t before = board_now();
  size_t size = __real_tac_send(node, datagram);
  uint32_t after = board_now();
  of->open += board_instructions(before, after) - around;
  return size;
}

static void do_nothing(const tac_real *constants, const tac_real *inputs, tac_real *memory, tac_real *outputs) {
  (void)constants;
  (void)inputs;
  (void)memory;
  (void)outputs;
}

/* Execute one instruction, followed by TURNS * PER_TURN instructions. */
static void turn_round(const tac_real *constants, const tac_real *inputs, tac_real *memory, tac_real *outputs) {
  uint32_t turns;
  (void)constants;
  (void)inputs;
  (void)memory;
  (void)outputs;
  __asm volatile("mov %0, %1\n1: subs %0, #1\n\tbne 1b" : "=&r"(turns) : "I"(TURNS) : "cc");
}

/* Return the number of instructions between the two readings inside time_first for a function. */
static uint32_t count_part(tac_part *run) {
  static tac_node_data data;
  static tac_part *volatile timed = time_first;
  data.first = run;
  current = &data;
  timed(NULL, NULL, NULL, NULL);
  return board_instructions(begun[0], ended[0]);
}

/* Return the number of instructions between two readings around the call of a function. */
static uint32_t count_call(tac_part *run) {
  static tac_part *volatile called;
  uint32_t before;
  called = run;
  before = board_now();
  called(NULL, NULL, NULL, NULL);
  return board_instructions(before, board_now());
}

/* Measure the overhead of readings, and return whether the timer gives the right count for a loop of known length. */
static bool calibrate(void) {
  around = count_part(do_nothing);
  around_part = count_call(time_first) - count_call(do_nothing);
  return count_part(turn_round) - around == TURNS * PER_TURN + 1;
}

static void tell(const char *name, const char *what, const tally *of, uint32_t ticks) {
  printf("%s %s %.0f %lu %lu\n", name, what, (double)of->total, (unsigned long)of->longest, (unsigned long)ticks);
}

int __wrap_main(int words, char **arguments) {
  int code;
  board_start_timer();
  if (!calibrate()) {
    printf("the timer does not count instructions; expected QEMU with -icount shift=7\n");
    return 2;
  }
  code = __real_main(words, arguments);
  for (size_t i = 0U; i < nodes && code == 0; i++) {
    close_tick(&counts[i]);
    tell(selfcheck_nodes[i].name, "step", &counts[i].step, counts[i].ticks);
    tell(selfcheck_nodes[i].name, "tick", &counts[i].tick, counts[i].ticks);
    tell(selfcheck_nodes[i].name, "all", &counts[i].all, counts[i].ticks);
  }
  return code;
}
