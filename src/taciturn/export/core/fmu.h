/* A policy as a functional mock-up unit: what FMI 2.0 and FMI 3.0 have in common. All nodes of the policy are in the
 * unit, and a step is one tick. Not for a device.
 *
 * Functions that may refuse return NULL, or a sentence that says why; then nothing has changed. */
#ifndef FMU_H
#define FMU_H

#include "fmu_data.h" /* generated: fmu_memory, fmu_start, what tells this unit apart, and its variables */
#include "taciturn_exchange.h"

typedef enum { FMU_INSTANTIATED, FMU_INITIALIZING, FMU_STEPPING, FMU_TERMINATED } fmu_phase;

/* All that changes while a unit runs. */
typedef struct {
  fmu_memory memory; /* of the nodes */
  tac_exchange exchange;
  double measured[FMU_MEASURED];
  double applied[FMU_APPLIED];
  bool lost[TAC_LINKS]; /* whether a packet that is sent in the next step is lost */
  bool sent[TAC_LINKS]; /* whether one was sent in the last */
  uint64_t sends[TAC_LINKS];
  uint64_t tick; /* the next one */
  double time;   /* at which it begins */
  fmu_phase phase;
} fmu_state;

typedef struct {
  fmu_state state;
  char sentence[256]; /* of the last refusal */
} fmu_unit;

/* A state as bytes that any instance of the same unit can read, on the same kind of machine. */
typedef struct {
  uint64_t stamp; /* of the unit */
  uint64_t check; /* of the state */
  fmu_state state;
} fmu_saved;

/* Begin anew, before initialization. */
void fmu_reset(fmu_unit *unit);

/* Return NULL where a token is that of this unit. */
const char *fmu_check_token(const char *token);

/* Go from one phase to the next: into initialization, which sets the time; out of it; to the end. */
const char *fmu_enter(fmu_unit *unit, double time);
const char *fmu_leave(fmu_unit *unit);
const char *fmu_end(fmu_unit *unit);

/* Read and write variables by their references. */
const char *fmu_get_number(fmu_unit *unit, uint32_t reference, double *value);
const char *fmu_get_truth(fmu_unit *unit, uint32_t reference, bool *value);
const char *fmu_get_count(fmu_unit *unit, uint32_t reference, uint64_t *value);
const char *fmu_set_number(fmu_unit *unit, uint32_t reference, double value);
const char *fmu_set_truth(fmu_unit *unit, uint32_t reference, bool value);

/* Go through a tick that begins at a time. Its measurement is what the inputs hold, and its input of the plant is what
 * the outputs hold then. */
const char *fmu_step(fmu_unit *unit, double time, double step);

/* Copy the state, without pointers, and take it up again: in this instance, or in another of the same unit. */
void fmu_save(const fmu_unit *unit, fmu_saved *saved);
const char *fmu_restore(fmu_unit *unit, const fmu_saved *saved);

#endif
