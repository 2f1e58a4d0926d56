/* A policy as a functional mock-up unit: common functions for FMI 2.0 and FMI 3.0. The unit contains all nodes of the
 * policy, and its step is one step of the policy. Not for a device.
 *
 * Functions that may fail return NULL, or a message with the reason. After a failure the state is unchanged. */
#ifndef FMU_H
#define FMU_H

#include "fmu_data.h" /* generated: fmu_memory, fmu_start, identification of the unit, and its variables */
#include "taciturn_exchange.h"

typedef enum { FMU_INSTANTIATED, FMU_INITIALIZING, FMU_STEPPING, FMU_TERMINATED } fmu_phase;

/* The complete state of a running unit. */
typedef struct {
  fmu_memory memory; /* memory of the nodes */
  tac_exchange exchange;
  double measured[FMU_MEASURED];
  bool missing[FMU_MEASURED]; /* whether a measurement of the next step is missing */
  double applied[FMU_APPLIED];
  bool lost[TAC_LINKS]; /* whether a packet sent in the next step is dropped */
  double late[TAC_LINKS]; /* number of steps after which it arrives, on a link that delays packets at random */
  bool sent[TAC_LINKS]; /* whether a packet was sent in the last step */
  uint64_t sends[TAC_LINKS];
  uint64_t tick; /* next step */
  double time;   /* time at which the next step begins */
  fmu_phase phase;
} fmu_state;

typedef struct {
  fmu_state state;
  char sentence[256]; /* message of the last failure */
} fmu_unit;

/* A saved state, which any instance of the same unit can restore on the same kind of machine. */
typedef struct {
  uint64_t stamp; /* identifies the unit */
  uint64_t check; /* checksum of the state */
  fmu_state state;
} fmu_saved;

/* Reset the unit to its state before initialization. */
void fmu_reset(fmu_unit *unit);

/* Return NULL if a token belongs to this unit. */
const char *fmu_check_token(const char *token);

/* Change the phase: enter initialization and set the time; leave initialization; terminate. */
const char *fmu_enter(fmu_unit *unit, double time);
const char *fmu_leave(fmu_unit *unit);
const char *fmu_end(fmu_unit *unit);

/* Read and write variables by reference. */
const char *fmu_get_number(fmu_unit *unit, uint32_t reference, double *value);
const char *fmu_get_truth(fmu_unit *unit, uint32_t reference, bool *value);
const char *fmu_get_count(fmu_unit *unit, uint32_t reference, uint64_t *value);
const char *fmu_set_number(fmu_unit *unit, uint32_t reference, double value);
const char *fmu_set_truth(fmu_unit *unit, uint32_t reference, bool value);

/* Execute a step that begins at a given time. The inputs of the unit are the measurement, and after the step its
 * outputs are the plant input. */
const char *fmu_step(fmu_unit *unit, double time, double step);

/* Save the state without pointers, and restore it in this instance or in another instance of the same unit. */
void fmu_save(const fmu_unit *unit, fmu_saved *saved);
const char *fmu_restore(fmu_unit *unit, const fmu_saved *saved);

#endif
