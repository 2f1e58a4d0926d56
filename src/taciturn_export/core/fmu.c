/* Functions of a functional mock-up unit that are common to all versions of FMI. */
#include "fmu.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#define LARGEST ((double)FLT_MAX) /* of a measurement or set-point: the largest number that packets carry */
#define SHARE 1e-6 /* permitted error of time and step size, relative to the step size */

static double magnitude(double value) {
  return (value < 0.0) ? -value : value;
}

/* Return whether two times are equal within SHARE of a step and rounding errors. */
static bool is_same(double one, double other, double time) {
  return magnitude(one - other) <= (SHARE * FMU_TICK) + (8.0 * DBL_EPSILON * magnitude(time));
}

void fmu_reset(fmu_unit *unit) {
  (void)memset(unit, 0, sizeof *unit);
  (void)memcpy(unit->state.measured, fmu_starts, sizeof unit->state.measured);
  unit->state.exchange.count = fmu_start(&unit->state.memory, unit->state.exchange.nodes);
}

const char *fmu_check_token(const char *token) {
  bool same = token != NULL && strcmp(token, FMU_TOKEN) == 0;
  return same ? NULL : "the token is that of another unit; expected " FMU_TOKEN;
}

const char *fmu_enter(fmu_unit *unit, double time) {
  if (unit->state.phase != FMU_INSTANTIATED) {
    return "the unit is initialized already; expected a reset first";
  }
  if (unit->state.exchange.count == 0U) {
    return "the data of the nodes are damaged; expected the exported files";
  }
  if (!(magnitude(time) <= DBL_MAX)) {
    return "the start time is not finite; expected a number of seconds";
  }
  unit->state.time = time;
  unit->state.phase = FMU_INITIALIZING;
  return NULL;
}

const char *fmu_leave(fmu_unit *unit) {
  if (unit->state.phase != FMU_INITIALIZING) {
    return "the unit is not being initialized; expected that initialization begins before it ends";
  }
  unit->state.phase = FMU_STEPPING;
  return NULL;
}

const char *fmu_end(fmu_unit *unit) {
  if (unit->state.phase != FMU_STEPPING) {
    return "the unit does not run; expected to end it after its initialization, and once";
  }
  unit->state.phase = FMU_TERMINATED;
  return NULL;
}

static const char *refuse_variable(fmu_unit *unit, const char *kind, uint32_t reference) {
  (void)snprintf(unit->sentence, sizeof unit->sentence,
                 "there is no %s with reference %lu; expected one that the model description lists", kind,
                 (unsigned long)reference);
  return unit->sentence;
}

/* Return whether a reference belongs to a variable of a used link; `first` is the reference of the first link. */
static bool is_of_link(uint32_t reference, uint32_t first) {
  return reference >= first && reference - first < (uint32_t)TAC_LINKS && fmu_links[reference - first];
}

/* Return whether a reference is that of the delay of a link that delays packets at random. */
static bool is_delay(uint32_t reference) {
  return reference >= FMU_LATE && reference - FMU_LATE < (uint32_t)TAC_LINKS && fmu_delays[reference - FMU_LATE];
}

/* Return whether a reference is that of the input which states that a measurement is missing. */
static bool is_sample(uint32_t reference) {
  return reference >= FMU_MISSING && reference - FMU_MISSING < (uint32_t)FMU_SENSED;
}

const char *fmu_get_number(fmu_unit *unit, uint32_t reference, double *value) {
  const fmu_state *state = &unit->state;
  if (reference == FMU_TIME) {
    *value = state->time;
  } else if (reference >= FMU_Y && reference - FMU_Y < (uint32_t)FMU_MEASURED) {
    *value = state->measured[reference - FMU_Y];
  } else if (reference >= FMU_U && reference - FMU_U < (uint32_t)FMU_APPLIED) {
    *value = state->applied[reference - FMU_U];
  } else if (reference >= FMU_SILENCE && reference < FMU_SILENCE + FMU_SILENCES) {
    *value = fmu_silence(&state->memory, reference - FMU_SILENCE);
  } else if (is_delay(reference)) {
    *value = state->late[reference - FMU_LATE];
  } else {
    return refuse_variable(unit, "number", reference);
  }
  return NULL;
}

const char *fmu_set_number(fmu_unit *unit, uint32_t reference, double value) {
  if (is_delay(reference)) {
    unit->state.late[reference - FMU_LATE] = value;
    return NULL;
  }
  if (reference < FMU_Y || reference - FMU_Y >= (uint32_t)FMU_MEASURED) {
    return refuse_variable(unit, "number that can be set", reference);
  }
  unit->state.measured[reference - FMU_Y] = value;
  return NULL;
}

const char *fmu_get_truth(fmu_unit *unit, uint32_t reference, bool *value) {
  const fmu_state *state = &unit->state;
  if (fmu_lossy && is_of_link(reference, FMU_LOST)) {
    *value = state->lost[reference - FMU_LOST];
  } else if (is_sample(reference)) {
    *value = state->missing[reference - FMU_MISSING];
  } else if (is_of_link(reference, FMU_SENT)) {
    *value = state->sent[reference - FMU_SENT];
  } else if (reference == FMU_DEGRADED) {
    *value = tac_exchange_degraded(&state->exchange);
  } else {
    return refuse_variable(unit, "truth value", reference);
  }
  return NULL;
}

const char *fmu_set_truth(fmu_unit *unit, uint32_t reference, bool value) {
  if (fmu_lossy && is_of_link(reference, FMU_LOST)) {
    unit->state.lost[reference - FMU_LOST] = value;
  } else if (is_sample(reference)) {
    unit->state.missing[reference - FMU_MISSING] = value;
  } else {
    return refuse_variable(unit, "truth value that can be set", reference);
  }
  return NULL;
}

const char *fmu_get_count(fmu_unit *unit, uint32_t reference, uint64_t *value) {
  if (!is_of_link(reference, FMU_SENDS)) {
    return refuse_variable(unit, "count", reference);
  }
  *value = unit->state.sends[reference - FMU_SENDS];
  return NULL;
}

/* Return the reason why a step cannot be executed, or NULL. */
static const char *check_step(fmu_unit *unit, double time, double step) {
  const fmu_state *state = &unit->state;
  if (state->phase != FMU_STEPPING) {
    return "the unit does not run; expected a step after the initialization and before the end";
  }
  if (!is_same(time, state->time, state->time)) { /* not by the size of `time`, which may be infinite */
    (void)snprintf(unit->sentence, sizeof unit->sentence,
                   "the step begins at %.9g s; expected %.9g s, where the last one ended", time, state->time);
    return unit->sentence;
  }
  if (!is_same(step, FMU_TICK, state->time)) {
    (void)snprintf(unit->sentence, sizeof unit->sentence,
                   "the step is %.9g s long; expected %.9g s, which is one tick of the policy", step, FMU_TICK);
    return unit->sentence;
  }
  for (unsigned i = 0U; i < (unsigned)FMU_MEASURED; i++) {
    if (!state->missing[i] && !(magnitude(state->measured[i]) <= LARGEST)) {
      bool given = i >= (unsigned)FMU_SENSED;
      (void)snprintf(unit->sentence, sizeof unit->sentence, "%s[%u] is %g; expected a finite number up to %g",
                     given ? "setpoint" : "y", i + 1U - (given ? (unsigned)FMU_SENSED : 0U), state->measured[i],
                     LARGEST);
      return unit->sentence;
    }
  }
  for (unsigned link = 0U; link < (unsigned)TAC_LINKS; link++) {
    double late = state->late[link];
    bool valid = late >= 0.0 && late < (double)TAC_WAITING;
    if (!valid || (double)(uint16_t)late < late) {
      (void)snprintf(unit->sentence, sizeof unit->sentence,
                     "the delay of link %u is %g; expected a whole number of steps below %d", link, late,
                     (int)TAC_WAITING);
      return unit->sentence;
    }
  }
  return NULL;
}

const char *fmu_step(fmu_unit *unit, double time, double step) {
  fmu_state *state = &unit->state;
  tac_real measured[FMU_MEASURED];
  tac_real applied[FMU_APPLIED];
  uint16_t late[TAC_LINKS];
  const char *refusal = check_step(unit, time, step);
  if (refusal != NULL) {
    return refusal;
  }
  for (unsigned i = 0U; i < (unsigned)FMU_MEASURED; i++) {
    measured[i] = state->missing[fmu_outputs[i]] ? (tac_real)NAN : (tac_real)state->measured[fmu_outputs[i]];
  }
  for (unsigned link = 0U; link < (unsigned)TAC_LINKS; link++) {
    late[link] = (uint16_t)state->late[link];
  }
  if (tac_exchange_step(&state->exchange, state->tick, measured, NULL, state->lost, late, state->sent) <
      state->exchange.count) {
    state->phase = FMU_TERMINATED;
    return "a node does not go on; expected a reset";
  }
  for (unsigned link = 0U; link < (unsigned)TAC_LINKS; link++) {
    state->sends[link] += state->sent[link] ? 1U : 0U;
  }
  tac_exchange_inputs(&state->exchange, applied);
  for (unsigned i = 0U; i < (unsigned)FMU_APPLIED; i++) {
    state->applied[fmu_inputs[i]] = (double)applied[i];
  }
  state->tick++;
  state->time = time + step;
  return NULL;
}

/* Copy the pointers of another node: they depend on the location of an instance and are not part of its state. */
static void point_as(tac_node *node, const tac_node *other) {
  node->data = other->data;
  node->channels = other->channels;
  node->inputs = other->inputs;
  node->memory = other->memory;
  node->outputs = other->outputs;
  node->input = other->input;
  node->spare = other->spare;
  node->sequences = other->sequences;
  node->places = other->places;
  (void)memcpy(node->keys, other->keys, sizeof node->keys);
  node->safe_input = other->safe_input;
}

/* Return the node of a state that corresponds to a node of another state. */
static tac_node *node_in(fmu_state *state, const fmu_state *other, const tac_node *node) {
  size_t at = (size_t)((const unsigned char *)node - (const unsigned char *)other);
  return (tac_node *)(void *)((unsigned char *)state + at);
}

/* Return the FNV-1a hash of the bytes of a state. */
static uint64_t checksum(const fmu_state *state) {
  const unsigned char *bytes = (const unsigned char *)state;
  uint64_t sum = UINT64_C(0xcbf29ce484222325);
  for (size_t i = 0U; i < sizeof *state; i++) {
    sum = (sum ^ bytes[i]) * UINT64_C(0x100000001b3);
  }
  return sum;
}

void fmu_save(const fmu_unit *unit, fmu_saved *saved) {
  tac_node nowhere; /* all pointers are NULL */
  const tac_exchange *exchange = &unit->state.exchange;
  (void)memset(&nowhere, 0, sizeof nowhere);
  (void)memcpy(&saved->state, &unit->state, sizeof saved->state);
  for (size_t i = 0U; i < exchange->count; i++) {
    point_as(node_in(&saved->state, &unit->state, exchange->nodes[i]), &nowhere);
    saved->state.exchange.nodes[i] = NULL;
  }
  saved->stamp = FMU_STAMP;
  saved->check = checksum(&saved->state);
}

const char *fmu_restore(fmu_unit *unit, const fmu_saved *saved) {
  tac_node *nodes[TAC_NODES];
  tac_node own[TAC_NODES];
  size_t count = unit->state.exchange.count;
  if (saved->stamp != FMU_STAMP) {
    return "the state is that of another unit; expected one that this unit has told";
  }
  if (saved->check != checksum(&saved->state)) {
    return "the state has been changed; expected the bytes that this unit has told";
  }
  for (size_t i = 0U; i < count; i++) {
    nodes[i] = unit->state.exchange.nodes[i];
    own[i] = *nodes[i];
  }
  (void)memcpy(&unit->state, &saved->state, sizeof unit->state);
  for (size_t i = 0U; i < count; i++) {
    unit->state.exchange.nodes[i] = nodes[i];
    point_as(nodes[i], &own[i]);
  }
  return NULL;
}
