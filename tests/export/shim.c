/* What tests ask of a node and no program does; the node under test has the type `device`. */
#include "device.h"

const tac_wire *shim_wire(const tac_node *node);
void shim_number(tac_node *node, uint32_t sequence);

const tac_wire *shim_wire(const tac_node *node) {
  return &node->data->wire;
}

/* Go on as if so many packets had been sent on each link. */
void shim_number(tac_node *node, uint32_t sequence) {
  for (unsigned i = 0U; i < node->data->send_count; i++) {
    node->sequences[i] = sequence;
  }
}
