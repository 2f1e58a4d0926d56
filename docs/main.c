/* The controller of the two masses on a board: what a program around an exported node
 * has to do.
 *
 * The program needs the folder of `taciturn export two-mass --c nodes --node controller`,
 * without the self-check.
 */

#include "two_mass_controller.h"

static two_mass_controller memory; /* all that the node remembers */
static uint8_t datagram[TAC_DATAGRAM];
static unsigned sent;

/* Yours: read the next datagram that has come, and return its size; 0: none has. */
static size_t receive(uint8_t *bytes)
{
  (void)bytes;
  return 0;
}

/* Yours: give a datagram to the radio. */
static void send(const uint8_t *bytes, size_t size)
{
  (void)bytes;
  (void)size;
  ++sent;
}

/* Yours: read the sensors. */
static void measure(tac_real *y)
{
  y[0] = 1;
  y[1] = 0;
}

int main(void)
{
  const tac_key none = {NULL, 0};
  /* 1: larger at each start */
  tac_node *node = two_mass_controller_start(&memory, 1, 0, none);
  /* yours: for ever, a turn whenever the timer says so */
  for (uint64_t tick = 0; tick < 100; ++tick) {
    tac_real y[2];
    size_t size;
    measure(y);
    while ((size = receive(datagram)) > 0) (void)tac_receive(node, datagram, size);
    if (!tac_step(node, tick, y, NULL)) return 1;
    while ((size = tac_send(node, datagram)) > 0) send(datagram, size);
  }
  return (sent > 0 && sent < 100) ? 0 : 2;
}
