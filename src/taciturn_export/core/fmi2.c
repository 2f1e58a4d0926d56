/* The interface FMI 2.0 for co-simulation of a unit. */
#include <limits.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "fmu.h"

typedef struct {
  fmu_unit unit;
  fmi2CallbackLogger log;
  fmi2ComponentEnvironment environment;
  char name[64];
} instance_of;

static fmi2Status tell(const instance_of *self, const char *sentence) {
  if (sentence == NULL) {
    return fmi2OK;
  }
  if (self != NULL && self->log != NULL) {
    self->log(self->environment, self->name, fmi2Error, "logStatusError", "%s", sentence);
  }
  return fmi2Error;
}

/* Report an unsupported function as an error. */
static fmi2Status refuse(fmi2Component c, const char *sentence) {
  return tell((const instance_of *)c, sentence);
}

const char *fmi2GetTypesPlatform(void) {
  return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void) {
  return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[]) {
  (void)loggingOn; /* errors are always logged, and nothing else */
  for (size_t i = 0U; i < nCategories; i++) {
    if (strcmp(categories[i], "logStatusError") != 0) {
      return refuse(c, "there is no such category of messages; expected logStatusError");
    }
  }
  return (c == NULL) ? fmi2Error : fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions,
                              fmi2Boolean visible, fmi2Boolean loggingOn) {
  instance_of *self = (instance_of *)calloc(1U, sizeof *self);
  const char *refusal = fmu_check_token(fmuGUID);
  (void)fmuResourceLocation;
  (void)visible;
  (void)loggingOn;
  if (self == NULL) {
    return NULL;
  }
  if (functions != NULL) {
    self->log = functions->logger;
    self->environment = functions->componentEnvironment;
  }
  if (instanceName != NULL) {
    (void)strncpy(self->name, instanceName, sizeof self->name - 1U);
  }
  if (refusal == NULL && fmuType != fmi2CoSimulation) {
    refusal = "the unit is for co-simulation; expected no model exchange";
  }
  if (tell(self, refusal) != fmi2OK) {
    free(self);
    return NULL;
  }
  fmu_reset(&self->unit);
  return self;
}

void fmi2FreeInstance(fmi2Component c) {
  free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance, fmi2Real startTime,
                               fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
  instance_of *self = (instance_of *)c;
  (void)toleranceDefined;
  (void)tolerance;
  (void)stopTimeDefined;
  (void)stopTime;
  if (self == NULL || self->unit.state.phase != FMU_INSTANTIATED) {
    return tell(self, "the experiment has begun; expected its times before the initialization");
  }
  self->unit.state.time = startTime;
  return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
  instance_of *self = (instance_of *)c;
  return (self == NULL) ? fmi2Error : tell(self, fmu_enter(&self->unit, self->unit.state.time));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
  instance_of *self = (instance_of *)c;
  return (self == NULL) ? fmi2Error : tell(self, fmu_leave(&self->unit));
}

fmi2Status fmi2Terminate(fmi2Component c) {
  instance_of *self = (instance_of *)c;
  return (self == NULL) ? fmi2Error : tell(self, fmu_end(&self->unit));
}

fmi2Status fmi2Reset(fmi2Component c) {
  instance_of *self = (instance_of *)c;
  if (self == NULL) {
    return fmi2Error;
  }
  fmu_reset(&self->unit);
  return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
  instance_of *self = (instance_of *)c;
  (void)noSetFMUStatePriorToCurrentPoint;
  return (self == NULL) ? fmi2Error
                        : tell(self, fmu_step(&self->unit, currentCommunicationPoint, communicationStepSize));
}

/* Access to variables. */

/* Return a count as an FMI 2.0 integer, limited to the largest integer. */
static fmi2Integer as_integer(uint64_t count) {
  return (count < (uint64_t)INT_MAX) ? (fmi2Integer)count : INT_MAX;
}

static fmi2Boolean as_boolean(bool value) {
  return value ? fmi2True : fmi2False;
}

static fmi2Real as_real(double value) {
  return value;
}

#define GET(Type, value_t, get, as)                                                                                    \
  fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2##Type value[]) {           \
    instance_of *self = (instance_of *)c;                                                                              \
    for (size_t i = 0U; i < nvr; i++) {                                                                                \
      value_t found;                                                                                                   \
      const char *refusal = (self == NULL) ? "" : get(&self->unit, vr[i], &found);                                     \
      if (refusal != NULL) {                                                                                           \
        return tell(self, refusal);                                                                                    \
      }                                                                                                                \
      value[i] = as(found);                                                                                            \
    }                                                                                                                  \
    return fmi2OK;                                                                                                     \
  }

#define SET(Type, set, is)                                                                                             \
  fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2##Type value[]) {     \
    instance_of *self = (instance_of *)c;                                                                              \
    for (size_t i = 0U; i < nvr; i++) {                                                                                \
      const char *refusal = (self == NULL) ? "" : set(&self->unit, vr[i], value[i] is);                                \
      if (refusal != NULL) {                                                                                           \
        return tell(self, refusal);                                                                                    \
      }                                                                                                                \
    }                                                                                                                  \
    return fmi2OK;                                                                                                     \
  }

GET(Real, double, fmu_get_number, as_real)
GET(Integer, uint64_t, fmu_get_count, as_integer)
GET(Boolean, bool, fmu_get_truth, as_boolean)
SET(Real, fmu_set_number, )
SET(Boolean, fmu_set_truth, != fmi2False)

/* Saving and restoring the state of an instance. */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
  const instance_of *self = (const instance_of *)c;
  if (self == NULL || FMUstate == NULL) {
    return fmi2Error;
  }
  if (*FMUstate == NULL) {
    *FMUstate = calloc(1U, sizeof(fmu_saved));
  }
  if (*FMUstate == NULL) {
    return tell(self, "there is no memory for a state; expected some");
  }
  fmu_save(&self->unit, (fmu_saved *)*FMUstate);
  return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
  instance_of *self = (instance_of *)c;
  if (self == NULL || FMUstate == NULL) {
    return fmi2Error;
  }
  return tell(self, fmu_restore(&self->unit, (const fmu_saved *)FMUstate));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
  (void)c;
  if (FMUstate != NULL) {
    free(*FMUstate);
    *FMUstate = NULL;
  }
  return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
  (void)c;
  (void)FMUstate;
  *size = sizeof(fmu_saved);
  return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size) {
  if (FMUstate == NULL || size < sizeof(fmu_saved)) {
    return refuse(c, "there is no room for the state; expected as many bytes as the unit says");
  }
  (void)memcpy(serializedState, FMUstate, sizeof(fmu_saved));
  return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate) {
  if (FMUstate == NULL || size != sizeof(fmu_saved)) {
    return refuse(c, "the state has another size; expected the bytes that this unit has told");
  }
  if (*FMUstate == NULL) {
    *FMUstate = calloc(1U, sizeof(fmu_saved));
  }
  if (*FMUstate == NULL) {
    return refuse(c, "there is no memory for a state; expected some");
  }
  (void)memcpy(*FMUstate, serializedState, size);
  return fmi2OK;
}

/* A step is complete when its call returns: the only status is the time of the last step, and no status is pending. */

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
  const instance_of *self = (const instance_of *)c;
  if (self == NULL || s != fmi2LastSuccessfulTime) {
    return fmi2Discard;
  }
  *value = self->unit.state.time;
  return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
  if (c == NULL || s != fmi2Terminated) {
    return fmi2Discard;
  }
  *value = fmi2False;
  return fmi2OK;
}

/* Unsupported functions. FMI requires that they exist; they report an error for any arguments. */

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) {
  return fmi2Discard;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) {
  return fmi2Discard;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) {
  return fmi2Discard;
}

#define REFERENCES const fmi2ValueReference vr[], size_t nvr
#define REFUSED(name, ...)                                                                                             \
  fmi2Status name(__VA_ARGS__) {                                                                                       \
    return refuse(c, #name " is nothing that this unit does; expected what its model description tells");             \
  }

REFUSED(fmi2SetInteger, fmi2Component c, REFERENCES, const fmi2Integer value[])
REFUSED(fmi2GetString, fmi2Component c, REFERENCES, fmi2String value[])
REFUSED(fmi2SetString, fmi2Component c, REFERENCES, const fmi2String value[])
REFUSED(fmi2GetDirectionalDerivative, fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
        const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[], fmi2Real dvUnknown[])
REFUSED(fmi2SetRealInputDerivatives, fmi2Component c, REFERENCES, const fmi2Integer order[], const fmi2Real value[])
REFUSED(fmi2GetRealOutputDerivatives, fmi2Component c, REFERENCES, const fmi2Integer order[], fmi2Real value[])
REFUSED(fmi2CancelStep, fmi2Component c)
REFUSED(fmi2EnterEventMode, fmi2Component c)
REFUSED(fmi2NewDiscreteStates, fmi2Component c, fmi2EventInfo *fmi2eventInfo)
REFUSED(fmi2EnterContinuousTimeMode, fmi2Component c)
REFUSED(fmi2CompletedIntegratorStep, fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint,
        fmi2Boolean *enterEventMode, fmi2Boolean *terminateSimulation)
REFUSED(fmi2SetTime, fmi2Component c, fmi2Real time)
REFUSED(fmi2SetContinuousStates, fmi2Component c, const fmi2Real x[], size_t nx)
REFUSED(fmi2GetDerivatives, fmi2Component c, fmi2Real derivatives[], size_t nx)
REFUSED(fmi2GetEventIndicators, fmi2Component c, fmi2Real eventIndicators[], size_t ni)
REFUSED(fmi2GetContinuousStates, fmi2Component c, fmi2Real x[], size_t nx)
REFUSED(fmi2GetNominalsOfContinuousStates, fmi2Component c, fmi2Real x_nominal[], size_t nx)
