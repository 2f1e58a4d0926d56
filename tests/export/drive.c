/* Steps a unit of FMI 3.0 through rows of a file, and compares every decision and every bit of the input.
 *
 *     drive LIBRARY TOKEN TICK ROWS LOSSY MEASURED APPLIED LINK...
 *
 * A row holds the measurement, whether a packet is lost on each link and whether one is sent, and the input. */
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"

enum { DEGRADED = 1, LOST = 16, SENT = 32, SENDS = 48, Y = 1024, U = 2048, MOST = 64 };

static void *library;

static void *find(const char *name) {
  void *found = dlsym(library, name);
  if (found == NULL) {
    printf("there is no %s\n", name);
    exit(2);
  }
  return found;
}

static void hear(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category, fmi3String message) {
  (void)environment;
  printf("%d %s: %s\n", (int)status, category, message);
}

static void expect(bool holds, const char *what, unsigned long tick) {
  if (!holds) {
    printf("tick %lu: %s\n", tick, what);
    exit(1);
  }
}

int main(int count, char **arguments) {
  double tick = strtod(arguments[3], NULL);
  bool lossy = strcmp(arguments[5], "1") == 0;
  size_t measured = (size_t)atoi(arguments[6]);
  size_t applied = (size_t)atoi(arguments[7]);
  size_t links = (size_t)(count - 8);
  size_t width = measured + 2U * links + applied;
  double row[MOST];
  double input[MOST];
  fmi3ValueReference y[MOST];
  fmi3ValueReference u[MOST];
  fmi3ValueReference lost[MOST];
  fmi3ValueReference sent[MOST];
  fmi3ValueReference sends[MOST];
  fmi3ValueReference degraded = DEGRADED;
  fmi3UInt64 sums[MOST] = {0U};
  fmi3UInt64 told[MOST] = {0U};
  fmi3Boolean truth[MOST];
  fmi3Boolean event;
  fmi3Boolean ended;
  fmi3Boolean early;
  fmi3Float64 reached;
  unsigned long k = 0U;
  FILE *file = fopen(arguments[4], "rb");
  fmi3Instance instance;
  fmi3SetFloat64TYPE *set_numbers;
  fmi3GetFloat64TYPE *get_numbers;
  fmi3SetBooleanTYPE *set_truths;
  fmi3GetBooleanTYPE *get_truths;
  fmi3DoStepTYPE *step;
  library = dlopen(arguments[1], RTLD_NOW | RTLD_LOCAL);
  if (library == NULL || file == NULL || width > MOST) {
    printf("the unit or the rows cannot be read\n");
    return 2;
  }
  set_numbers = (fmi3SetFloat64TYPE *)find("fmi3SetFloat64");
  get_numbers = (fmi3GetFloat64TYPE *)find("fmi3GetFloat64");
  set_truths = (fmi3SetBooleanTYPE *)find("fmi3SetBoolean");
  get_truths = (fmi3GetBooleanTYPE *)find("fmi3GetBoolean");
  step = (fmi3DoStepTYPE *)find("fmi3DoStep");
  for (size_t i = 0U; i < MOST; i++) {
    y[i] = (fmi3ValueReference)(Y + i);
    u[i] = (fmi3ValueReference)(U + i);
  }
  for (size_t i = 0U; i < links; i++) {
    lost[i] = (fmi3ValueReference)(LOST + atoi(arguments[8U + i]));
    sent[i] = (fmi3ValueReference)(SENT + atoi(arguments[8U + i]));
    sends[i] = (fmi3ValueReference)(SENDS + atoi(arguments[8U + i]));
  }
  instance = ((fmi3InstantiateCoSimulationTYPE *)find("fmi3InstantiateCoSimulation"))(
      "driven", arguments[2], "", false, false, false, false, NULL, 0U, NULL, hear, NULL);
  expect(instance != NULL, "no instance", k);
  expect(((fmi3EnterInitializationModeTYPE *)find("fmi3EnterInitializationMode"))(instance, false, 0.0, 0.0, false,
                                                                                  0.0) == fmi3OK,
         "no initialization", k);
  expect(((fmi3ExitInitializationModeTYPE *)find("fmi3ExitInitializationMode"))(instance) == fmi3OK, "no end of it", k);
  while (fread(row, sizeof row[0], width, file) == width) {
    const double *fate = row + measured;
    const double *used = fate + links;
    expect(set_numbers(instance, y, measured, row, measured) == fmi3OK, "y cannot be set", k);
    for (size_t i = 0U; i < links; i++) {
      truth[i] = fate[i] > 0.0;
    }
    expect(!lossy || set_truths(instance, lost, links, truth, links) == fmi3OK, "losses cannot be set", k);
    expect(step(instance, (double)k * tick, tick, true, &event, &ended, &early, &reached) == fmi3OK, "no step", k);
    expect(get_numbers(instance, u, applied, input, applied) == fmi3OK, "u cannot be read", k);
    expect(memcmp(input, used + links, applied * sizeof input[0]) == 0, "u has other bits", k);
    expect(get_truths(instance, sent, links, truth, links) == fmi3OK, "what was sent cannot be read", k);
    for (size_t i = 0U; i < links; i++) {
      expect(truth[i] == (used[i] > 0.0), "a link was not used as expected", k);
      sums[i] += truth[i] ? 1U : 0U;
    }
    k++;
  }
  expect(((fmi3GetUInt64TYPE *)find("fmi3GetUInt64"))(instance, sends, links, told, links) == fmi3OK, "no counts", k);
  expect(memcmp(told, sums, sizeof told) == 0, "counts are not those of what was sent", k);
  expect(get_truths(instance, &degraded, 1U, truth, 1U) == fmi3OK && !truth[0], "a node is degraded", k);
  expect(((fmi3TerminateTYPE *)find("fmi3Terminate"))(instance) == fmi3OK, "no end", k);
  ((fmi3FreeInstanceTYPE *)find("fmi3FreeInstance"))(instance);
  printf("%lu\n", k);
  return 0;
}
