/* taciturn: the self-check. The nodes exchange datagrams in each step, and their decisions and inputs are compared with
 * the design bit for bit.
 *
 *     ./selfcheck          use the rows that are compiled in
 *     ./selfcheck FILE     use rows of a file, in the same order and in the number format of the machine
 */
#include <stdio.h>
#include <string.h>

#include "selfcheck.h"
#include "taciturn_exchange.h"

#define NUMBERS 1024

static tac_exchange exchange;

static bool step(uint64_t tick, const tac_real *row)
{
  const tac_real *drawn = row + selfcheck_measured;
  const tac_real *arrived = drawn + selfcheck_drawn;
  const tac_real *expected = arrived + selfcheck_link_count;
  const tac_real *applied = expected + selfcheck_link_count;
  bool lost[TAC_LINKS];
  bool sent[TAC_LINKS];
  uint16_t late[TAC_LINKS]; /* a row has 1 plus the delay of a packet, or 0 if it is dropped */
  tac_real input[NUMBERS];
  memset(lost, 0, sizeof lost);
  memset(late, 0, sizeof late);
  for (size_t i = 0; i < selfcheck_link_count; ++i) {
    lost[selfcheck_links[i]] = !(arrived[i] > 0);
    late[selfcheck_links[i]] = (uint16_t)((arrived[i] > 1) ? arrived[i] - 1 : 0);
  }
  const size_t done = tac_exchange_step(&exchange, tick, row, drawn, lost, late, sent);
  if (done < exchange.count) {
    printf("step %lu: the %s does not continue\n", (unsigned long)tick, selfcheck_nodes[done].name);
    return false;
  }
  tac_exchange_inputs(&exchange, input);
  for (size_t i = 0; i < selfcheck_applied; ++i) {
    if (memcmp(&input[i], &applied[i], sizeof input[i]) != 0) {
      printf("step %lu: the input of the plant is %.17g; expected %.17g\n", (unsigned long)tick, (double)input[i],
             (double)applied[i]);
      return false;
    }
  }
  for (size_t i = 0; i < selfcheck_link_count; ++i) {
    const bool used = sent[selfcheck_links[i]];
    if (used != (expected[i] > 0)) {
      printf("step %lu: link %u was %s\n", (unsigned long)tick, (unsigned)selfcheck_links[i],
             used ? "used; expected silence" : "silent; expected a packet");
      return false;
    }
  }
  return true;
}

int main(int count, char **arguments)
{
  const size_t width = selfcheck_measured + selfcheck_drawn + 2u * selfcheck_link_count + selfcheck_applied;
  static tac_real held[NUMBERS];
  FILE *file = NULL;
  uint64_t tick = 0;
  if (count > 1) {
    file = fopen(arguments[1], "rb");
    if (file == NULL) {
      printf("%s cannot be opened; expected rows of numbers\n", arguments[1]);
      return 2;
    }
  }
  if (width > NUMBERS) {
    printf("a row has %lu numbers; expected %d at most\n", (unsigned long)width, NUMBERS);
    return 2;
  }
  for (size_t i = 0; i < selfcheck_node_count; ++i) {
    exchange.nodes[i] = selfcheck_nodes[i].start();
    if (exchange.nodes[i] == NULL) {
      printf("the data of the %s are damaged or of another version; expected the exported files\n",
             selfcheck_nodes[i].name);
      return 1;
    }
  }
  exchange.count = selfcheck_node_count;
  for (;;) {
    const tac_real *row = held;
    if (file != NULL) {
      if (fread(held, sizeof held[0], width, file) != width) {
        break;
      }
    } else if (tick == selfcheck_rows) {
      break;
    } else {
      row = &selfcheck_vector[tick * width];
    }
    if (!step(tick, row)) {
      return 1;
    }
    ++tick;
  }
  for (size_t i = 0; i < selfcheck_node_count; ++i) {
    if (tac_degraded(exchange.nodes[i]) && exchange.nodes[i]->counters.missing == 0U) {
      printf("the %s is degraded; expected that nothing is lost but what is to be\n", selfcheck_nodes[i].name);
      return 1;
    }
  }
  printf("%s: %lu steps compared, every decision and every bit of the input agrees\n", selfcheck_name,
         (unsigned long)tick);
  return (tick > 0u) ? 0 : 1;
}
