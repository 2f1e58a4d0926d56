/* What tests ask of a node and no program does; the node under test has the type `device`. */
#include "device.h"

size_t shim_size(void);
const tac_wire *shim_wire(const tac_node *node);
const tac_counters *shim_counters(const tac_node *node);
const tac_real *shim_memory(const tac_node *node);
const tac_real *shim_inputs(const tac_node *node);
unsigned shim_waiting(const tac_node *node);
void shim_number(tac_node *node, uint32_t sequence);

size_t shim_size(void) {
  return sizeof(device);
}

const tac_wire *shim_wire(const tac_node *node) {
  return &node->data->wire;
}

const tac_counters *shim_counters(const tac_node *node) {
  return &node->counters;
}

const tac_real *shim_memory(const tac_node *node) {
  return node->memory;
}

const tac_real *shim_inputs(const tac_node *node) {
  return node->inputs;
}

unsigned shim_waiting(const tac_node *node) {
  unsigned count = 0U;
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
      count += node->channels[i].waits[place] ? 1U : 0U;
    }
  }
  return count;
}

/* Go on as if so many packets had been sent on each link. */
void shim_number(tac_node *node, uint32_t sequence) {
  for (unsigned i = 0U; i < node->data->send_count; i++) {
    node->sequences[i] = sequence;
  }
}
