/* Lets the nodes exchange datagrams, tick by tick, and compares what they decide and apply with the design, bit for
 * bit.
 *
 *     ./selfcheck          the rows that are compiled in
 *     ./selfcheck FILE     rows of a file, in the same order, as the machine holds numbers
 */
#include <stdio.h>
#include <string.h>

#include "selfcheck.h"

#define NODES 3
#define WAITING 8
#define NUMBERS 1024
#define KIND_AT 5
#define LINK_AT 6

typedef struct {
  uint8_t bytes[TAC_DATAGRAM];
  size_t size;
} datagram;

static tac_node *nodes[NODES];
static datagram boxes[NODES][WAITING];
static size_t counts[NODES];

static size_t listener(unsigned kind, unsigned link)
{
  for (size_t i = 0; i < selfcheck_node_count; ++i) {
    for (size_t c = 0; c < nodes[i]->data->channel_count; ++c) {
      const tac_channel_data *channel = &nodes[i]->data->channels[c];
      if ((channel->kind == kind) && (channel->link == link)) {
        return i;
      }
    }
  }
  return NODES;
}

static size_t place_of(unsigned link)
{
  size_t i = 0;
  while ((i < selfcheck_link_count) && (selfcheck_links[i] != link)) {
    ++i;
  }
  return i;
}

/* Hand the packets of a node on, but for those that are lost; note which links were used. */
static bool deliver(tac_node *node, const tac_real *arrived, bool *sent)
{
  datagram next;
  while ((next.size = tac_send(node, next.bytes)) > 0u) {
    const unsigned kind = next.bytes[KIND_AT];
    const unsigned link = next.bytes[LINK_AT];
    const size_t to = listener(kind, link);
    if (kind == TAC_DATA) {
      sent[place_of(link)] = true;
    }
    if ((to == NODES) || ((kind == TAC_DATA) && !(arrived[place_of(link)] > 0))) {
      continue;
    }
    if (counts[to] == WAITING) {
      return false;
    }
    boxes[to][counts[to]] = next;
    ++counts[to];
  }
  return true;
}

static bool step(uint64_t tick, const tac_real *row)
{
  const tac_real *drawn = row + selfcheck_measured;
  const tac_real *arrived = drawn + selfcheck_drawn;
  const tac_real *expected = arrived + selfcheck_link_count;
  const tac_real *applied = expected + selfcheck_link_count;
  bool sent[] = {false, false, false};
  for (size_t i = 0; i < selfcheck_node_count; ++i) {
    tac_node *node = nodes[i];
    for (size_t k = 0; k < counts[i]; ++k) {
      (void)tac_receive(node, boxes[i][k].bytes, boxes[i][k].size);
    }
    counts[i] = 0;
    if (!tac_step(node, tick, row, (node->data->drawn_count > 0u) ? drawn : NULL) || !deliver(node, arrived, sent)) {
      printf("tick %lu: the %s does not go on\n", (unsigned long)tick, selfcheck_nodes[i].name);
      return false;
    }
    const tac_real *input = tac_input(node);
    if ((input != NULL) && (memcmp(input, applied, selfcheck_applied * sizeof *input) != 0)) {
      printf("tick %lu: the input of the plant is %.17g; expected %.17g\n", (unsigned long)tick, (double)input[0],
             (double)applied[0]);
      return false;
    }
  }
  for (size_t i = 0; i < selfcheck_link_count; ++i) {
    if (sent[i] != (expected[i] > 0)) {
      printf("tick %lu: link %u was %s\n", (unsigned long)tick, (unsigned)selfcheck_links[i],
             sent[i] ? "used; expected silence" : "silent; expected a packet");
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
    nodes[i] = selfcheck_nodes[i].start();
  }
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
    if (tac_degraded(nodes[i])) {
      printf("the %s is degraded; expected that nothing is lost but what is to be\n", selfcheck_nodes[i].name);
      return 1;
    }
  }
  printf("%s: %lu ticks compared, every decision and every bit of the input agrees\n", selfcheck_name,
         (unsigned long)tick);
  return (tick > 0u) ? 0 : 1;
}
