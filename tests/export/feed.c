/* Datagrams from standard input, given to the node under test, whose type is `device`. A record is the size in two
 * bytes, big-endian, and so many bytes in memory of just that size; size 0 begins the next step k, whose measurement,
 * if the node has a sensor, is (k mod 8 - 3)/4, 0, 0, ... What the node sends is printed in hexadecimal digits, and at
 * the end its counters. Whoever compiles this checks addresses and undefined behaviour. `feed key` uses a key, and
 * `feed steps N` prints a line after each step with the N inputs of the plant. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "device.h"

static device self;
static const uint8_t secret[16] = "sixteen bytes...";

static void print_sent(tac_node *node) {
  uint8_t datagram[TAC_DATAGRAM];
  size_t size;
  while ((size = tac_send(node, datagram)) > 0U) {
    for (size_t i = 0U; i < size; i++) {
      printf("%02x", datagram[i]);
    }
    printf("\n");
  }
}

int main(int count, char **arguments) {
  static tac_real measurement[64];
  const tac_key none = {NULL, 0U};
  const tac_key key = {secret, (uint8_t)sizeof secret};
  bool keyed = count > 1 && strcmp(arguments[1], "key") == 0;
  tac_node *node = device_start(&self, 9U, 0U, keyed ? key : none);
  unsigned long shown = (count > 2 && strcmp(arguments[1], "steps") == 0) ? strtoul(arguments[2], NULL, 10) : 0U;
  uint64_t tick = 0U;
  int high;
  if (node == NULL) {
    return 2;
  }
  while ((high = getchar()) != EOF) {
    size_t size = ((size_t)high << 8U) | (size_t)getchar();
    uint8_t *bytes = malloc(size);
    if (size == 0U) {
      measurement[0] = ((tac_real)(tick % 8U) - (tac_real)3) / (tac_real)4;
      (void)tac_step(node, tick, measurement, NULL);
      tick++;
      print_sent(node);
      if (count > 2) {
        printf("step");
        for (unsigned long i = 0U; i < shown; i++) {
          printf(" %a", (double)tac_input(node)[i]);
        }
        printf("\n");
      }
    } else if (bytes != NULL && fread(bytes, 1U, size, stdin) == size) {
      (void)tac_receive(node, bytes, size);
    }
    free(bytes);
    print_sent(node);
  }
  printf("received %u used %u late %u replayed %u forged %u unproven %u ahead %u duplicate %u misdirected %u "
         "superseded %u malformed %u corrupted %u foreign %u overflowed %u\n", node->counters.received,
         node->counters.used, node->counters.late, node->counters.replayed, node->counters.forged,
         node->counters.unproven, node->counters.ahead, node->counters.duplicate, node->counters.misdirected,
         node->counters.superseded, node->counters.malformed, node->counters.corrupted, node->counters.foreign,
         node->counters.overflowed);
  return 0;
}
