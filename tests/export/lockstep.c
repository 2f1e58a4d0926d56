/* A node in C among nodes on a host, in virtual time over UDP: `lockstep STEPS`. Compile it with
 *
 *     -DNODE_HEADER='"NODE.h"' -DNODE=NODE -DNODE_START=NODE_start
 *
 * It prints the port on which it listens, and reads those of its peer and of the plant. */
#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include NODE_HEADER

enum { MOST = 8, NUMBERS = 16, PATIENCE = 30000 /* milliseconds without a datagram */ };

typedef struct {
  uint8_t bytes[TAC_DATAGRAM];
  size_t size;
  uint16_t port;
} mail;

static NODE memory;
static mail last[MOST]; /* what the last step has sent */
static size_t count;
static int line;

static void give(const mail *one) {
  struct sockaddr_in to;
  memset(&to, 0, sizeof to);
  to.sin_family = AF_INET;
  to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  to.sin_port = htons(one->port);
  (void)sendto(line, one->bytes, one->size, 0, (const struct sockaddr *)&to, sizeof to);
}

static void apply(const tac_node *node, uint16_t port) {
  tac_packet packet;
  memset(&packet, 0, sizeof packet);
  packet.kind = TAC_INPUT;
  packet.link = TAC_PLANT_LINK;
  packet.entries = node->data->applied_count;
  packet.tick = node->tick;
  packet.sequence = (uint32_t)(node->tick & UINT32_MAX);
  packet.epoch = node->epoch;
  for (unsigned i = 0; i < packet.entries; i++) {
    packet.values[i] = tac_input(node)[i];
  }
  last[count].size = tac_encode(&node->data->wire, node->keys[0][0], &packet, last[count].bytes);
  last[count].port = port;
  count++;
}

static int listen_somewhere(void) {
  struct sockaddr_in here;
  socklen_t size = sizeof here;
  memset(&here, 0, sizeof here);
  here.sin_family = AF_INET;
  here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  line = socket(AF_INET, SOCK_DGRAM, 0);
  if (line < 0 || bind(line, (const struct sockaddr *)&here, sizeof here) != 0 ||
      getsockname(line, (struct sockaddr *)&here, &size) != 0) {
    return 0;
  }
  return ntohs(here.sin_port);
}

int main(int words, char **arguments) {
  const tac_key none = {NULL, 0};
  const uint64_t steps = (words > 1) ? strtoul(arguments[1], NULL, 10) : 0;
  tac_node *node = NODE_START(&memory, 1, 0, none);
  tac_real y[NUMBERS];
  unsigned peer = 0, plant = 0;
  bool measured = false;
  struct pollfd waiting;
  if (node == NULL) {
    return 2;
  }
  tac_mark_after(node, 0); /* in virtual time every step ends with marks */
  printf("%d\n", listen_somewhere());
  fflush(stdout);
  if (scanf("%u %u", &peer, &plant) != 2) {
    return 2;
  }
  waiting.fd = line;
  waiting.events = POLLIN;
  while (poll(&waiting, 1, PATIENCE) > 0) { /* after the last step it still repeats it, until it is ended */
    uint8_t datagram[2 * TAC_DATAGRAM];
    const ssize_t size = recv(line, datagram, sizeof datagram, 0);
    const uint64_t next = node->begun ? node->tick + 1 : 0;
    const uint32_t doubled = node->counters.duplicate;
    bool again = false;
    tac_packet packet;
    if (size > 0 && tac_decode(&node->data->wire, none, datagram, (size_t)size, &packet) == TAC_OK &&
        packet.kind == TAC_MEASUREMENT) {
      again = packet.tick < next;
      measured = measured || packet.tick == next;
      for (unsigned i = 0; i < packet.entries && packet.tick == next; i++) {
        y[i] = packet.values[i];
      }
    } else if (size > 0) {
      (void)tac_receive(node, datagram, (size_t)size);
      again = node->counters.duplicate != doubled;
    }
    for (size_t i = 0; again && i < count; i++) {
      give(&last[i]);
    }
    while ((node->begun ? node->tick + 1 : 0) < steps && tac_ready(node) &&
           (measured || node->data->measurement_count == 0)) {
      measured = false;
      count = 0;
      if (!tac_step(node, node->begun ? node->tick + 1 : 0, y, NULL)) {
        return 3;
      }
      while (count < MOST - 1 && (last[count].size = tac_send(node, last[count].bytes)) > 0) {
        last[count].port = (uint16_t)peer;
        count++;
      }
      if (tac_input(node) != NULL) {
        apply(node, (uint16_t)plant);
      }
      for (size_t i = 0; i < count; i++) {
        give(&last[i]);
      }
    }
  }
  return 0;
}
