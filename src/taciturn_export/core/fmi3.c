/* The interface FMI 3.0 for co-simulation of a unit. */
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "fmu.h"

typedef struct {
  fmu_unit unit;
  fmi3InstanceEnvironment environment;
  fmi3LogMessageCallback log;
} instance_of;

static fmi3Status tell(const instance_of *self, const char *sentence) {
  if (sentence == NULL) {
    return fmi3OK;
  }
  if (self != NULL && self->log != NULL) {
    self->log(self->environment, fmi3Error, "logStatusError", sentence);
  }
  return fmi3Error;
}

/* Report an unsupported function as an error. */
static fmi3Status refuse(fmi3Instance instance, const char *sentence) {
  return tell((const instance_of *)instance, sentence);
}

const char *fmi3GetVersion(void) {
  return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
  (void)loggingOn; /* errors are always logged, and nothing else */
  for (size_t i = 0U; i < nCategories; i++) {
    if (strcmp(categories[i], "logStatusError") != 0) {
      return refuse(instance, "there is no such category of messages; expected logStatusError");
    }
  }
  return (instance == NULL) ? fmi3Error : fmi3OK;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken,
                                         fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                         fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference requiredIntermediateVariables[],
                                         size_t nRequiredIntermediateVariables,
                                         fmi3InstanceEnvironment instanceEnvironment,
                                         fmi3LogMessageCallback logMessage,
                                         fmi3IntermediateUpdateCallback intermediateUpdate) {
  instance_of *self;
  const char *refusal = fmu_check_token(instantiationToken);
  (void)instanceName;
  (void)resourcePath;
  (void)visible;
  (void)loggingOn;
  (void)earlyReturnAllowed;
  (void)requiredIntermediateVariables;
  (void)intermediateUpdate;
  if (refusal == NULL && (eventModeUsed || nRequiredIntermediateVariables > 0U)) {
    refusal = "the unit has no event mode and no intermediate variables; expected neither";
  }
  if (refusal != NULL) {
    if (logMessage != NULL) {
      logMessage(instanceEnvironment, fmi3Error, "logStatusError", refusal);
    }
    return NULL;
  }
  self = (instance_of *)calloc(1U, sizeof *self);
  if (self != NULL) {
    self->environment = instanceEnvironment;
    self->log = logMessage;
    fmu_reset(&self->unit);
  }
  return self;
}

void fmi3FreeInstance(fmi3Instance instance) {
  free(instance);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
  instance_of *self = (instance_of *)instance;
  (void)toleranceDefined;
  (void)tolerance;
  (void)stopTimeDefined;
  (void)stopTime;
  return (self == NULL) ? fmi3Error : tell(self, fmu_enter(&self->unit, startTime));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
  instance_of *self = (instance_of *)instance;
  return (self == NULL) ? fmi3Error : tell(self, fmu_leave(&self->unit));
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
  instance_of *self = (instance_of *)instance;
  return (self == NULL) ? fmi3Error : tell(self, fmu_end(&self->unit));
}

fmi3Status fmi3Reset(fmi3Instance instance) {
  instance_of *self = (instance_of *)instance;
  if (self == NULL) {
    return fmi3Error;
  }
  fmu_reset(&self->unit);
  return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
  instance_of *self = (instance_of *)instance;
  fmi3Status status;
  (void)noSetFMUStatePriorToCurrentPoint;
  if (self == NULL) {
    return fmi3Error;
  }
  status = tell(self, fmu_step(&self->unit, currentCommunicationPoint, communicationStepSize));
  *eventHandlingNeeded = fmi3False;
  *terminateSimulation = fmi3False;
  *earlyReturn = fmi3False;
  *lastSuccessfulTime = self->unit.state.time;
  return status;
}

/* Access to variables. All variables are scalars, so the numbers of values and references are equal. */

static const char *const UNEQUAL = "there are not as many values as references; expected scalars";

#define GET(Type, value_t, get)                                                                                        \
  fmi3Status fmi3Get##Type(fmi3Instance instance, const fmi3ValueReference valueReferences[],                          \
                           size_t nValueReferences, fmi3##Type values[], size_t nValues) {                             \
    instance_of *self = (instance_of *)instance;                                                                       \
    if (self == NULL || nValues != nValueReferences) {                                                                 \
      return tell(self, UNEQUAL);                                                                                      \
    }                                                                                                                  \
    for (size_t i = 0U; i < nValueReferences; i++) {                                                                   \
      value_t value;                                                                                                   \
      const char *refusal = get(&self->unit, valueReferences[i], &value);                                              \
      if (refusal != NULL) {                                                                                           \
        return tell(self, refusal);                                                                                    \
      }                                                                                                                \
      values[i] = value;                                                                                               \
    }                                                                                                                  \
    return fmi3OK;                                                                                                     \
  }

#define SET(Type, set)                                                                                                 \
  fmi3Status fmi3Set##Type(fmi3Instance instance, const fmi3ValueReference valueReferences[],                          \
                           size_t nValueReferences, const fmi3##Type values[], size_t nValues) {                       \
    instance_of *self = (instance_of *)instance;                                                                       \
    if (self == NULL || nValues != nValueReferences) {                                                                 \
      return tell(self, UNEQUAL);                                                                                      \
    }                                                                                                                  \
    for (size_t i = 0U; i < nValueReferences; i++) {                                                                   \
      const char *refusal = set(&self->unit, valueReferences[i], values[i]);                                           \
      if (refusal != NULL) {                                                                                           \
        return tell(self, refusal);                                                                                    \
      }                                                                                                                \
    }                                                                                                                  \
    return fmi3OK;                                                                                                     \
  }

GET(Float64, double, fmu_get_number)
GET(Boolean, bool, fmu_get_truth)
GET(UInt64, uint64_t, fmu_get_count)
SET(Float64, fmu_set_number)
SET(Boolean, fmu_set_truth)

/* Saving and restoring the state of an instance. */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
  const instance_of *self = (const instance_of *)instance;
  if (self == NULL || FMUState == NULL) {
    return fmi3Error;
  }
  if (*FMUState == NULL) {
    *FMUState = calloc(1U, sizeof(fmu_saved));
  }
  if (*FMUState == NULL) {
    return tell(self, "there is no memory for a state; expected some");
  }
  fmu_save(&self->unit, (fmu_saved *)*FMUState);
  return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
  instance_of *self = (instance_of *)instance;
  if (self == NULL || FMUState == NULL) {
    return fmi3Error;
  }
  return tell(self, fmu_restore(&self->unit, (const fmu_saved *)FMUState));
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
  (void)instance;
  if (FMUState != NULL) {
    free(*FMUState);
    *FMUState = NULL;
  }
  return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
  (void)instance;
  (void)FMUState;
  *size = sizeof(fmu_saved);
  return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte serializedState[],
                                 size_t size) {
  if (FMUState == NULL || size < sizeof(fmu_saved)) {
    return refuse(instance, "there is no room for the state; expected as many bytes as the unit says");
  }
  (void)memcpy(serializedState, FMUState, sizeof(fmu_saved));
  return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[], size_t size,
                                   fmi3FMUState *FMUState) {
  if (FMUState == NULL || size != sizeof(fmu_saved)) {
    return refuse(instance, "the state has another size; expected the bytes that this unit has told");
  }
  if (*FMUState == NULL) {
    *FMUState = calloc(1U, sizeof(fmu_saved));
  }
  if (*FMUState == NULL) {
    return refuse(instance, "there is no memory for a state; expected some");
  }
  (void)memcpy(*FMUState, serializedState, size);
  return fmi3OK;
}

/* Unsupported functions. FMI requires that they exist; they report an error for any arguments. */

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

#define INSTANCE fmi3Instance instance
#define REFERENCES const fmi3ValueReference valueReferences[], size_t nValueReferences
#define REFUSED(name, ...)                                                                                             \
  fmi3Status name(__VA_ARGS__) {                                                                                       \
    return refuse(instance, #name " is nothing that this unit does; expected what its model description tells");      \
  }
#define NO_VARIABLES(Type)                                                                                             \
  REFUSED(fmi3Get##Type, INSTANCE, REFERENCES, fmi3##Type values[], size_t nValues)                                    \
  REFUSED(fmi3Set##Type, INSTANCE, REFERENCES, const fmi3##Type values[], size_t nValues)

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(String)
REFUSED(fmi3SetUInt64, INSTANCE, REFERENCES, const fmi3UInt64 values[], size_t nValues)
REFUSED(fmi3GetBinary, INSTANCE, REFERENCES, size_t valueSizes[], fmi3Binary values[], size_t nValues)
REFUSED(fmi3SetBinary, INSTANCE, REFERENCES, const size_t valueSizes[], const fmi3Binary values[], size_t nValues)
REFUSED(fmi3GetClock, INSTANCE, REFERENCES, fmi3Clock values[])
REFUSED(fmi3SetClock, INSTANCE, REFERENCES, const fmi3Clock values[])
REFUSED(fmi3GetNumberOfVariableDependencies, INSTANCE, fmi3ValueReference valueReference, size_t *nDependencies)
REFUSED(fmi3GetVariableDependencies, INSTANCE, fmi3ValueReference dependent, size_t elementIndicesOfDependent[],
        fmi3ValueReference independents[], size_t elementIndicesOfIndependents[],
        fmi3DependencyKind dependencyKinds[], size_t nDependencies)
REFUSED(fmi3GetDirectionalDerivative, INSTANCE, const fmi3ValueReference unknowns[], size_t nUnknowns,
        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
        fmi3Float64 sensitivity[], size_t nSensitivity)
REFUSED(fmi3GetAdjointDerivative, INSTANCE, const fmi3ValueReference unknowns[], size_t nUnknowns,
        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
        fmi3Float64 sensitivity[], size_t nSensitivity)
REFUSED(fmi3EnterEventMode, INSTANCE)
REFUSED(fmi3EnterStepMode, INSTANCE)
REFUSED(fmi3EnterConfigurationMode, INSTANCE)
REFUSED(fmi3ExitConfigurationMode, INSTANCE)
REFUSED(fmi3GetOutputDerivatives, INSTANCE, REFERENCES, const fmi3Int32 orders[], fmi3Float64 values[], size_t nValues)
REFUSED(fmi3GetIntervalDecimal, INSTANCE, REFERENCES, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
REFUSED(fmi3GetIntervalFraction, INSTANCE, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
        fmi3IntervalQualifier qualifiers[])
REFUSED(fmi3GetShiftDecimal, INSTANCE, REFERENCES, fmi3Float64 shifts[])
REFUSED(fmi3GetShiftFraction, INSTANCE, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
REFUSED(fmi3SetIntervalDecimal, INSTANCE, REFERENCES, const fmi3Float64 intervals[])
REFUSED(fmi3SetIntervalFraction, INSTANCE, REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSED(fmi3SetShiftDecimal, INSTANCE, REFERENCES, const fmi3Float64 shifts[])
REFUSED(fmi3SetShiftFraction, INSTANCE, REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSED(fmi3EvaluateDiscreteStates, INSTANCE)
REFUSED(fmi3UpdateDiscreteStates, INSTANCE, fmi3Boolean *discreteStatesNeedUpdate, fmi3Boolean *terminateSimulation,
        fmi3Boolean *nominalsOfContinuousStatesChanged, fmi3Boolean *valuesOfContinuousStatesChanged,
        fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime)
REFUSED(fmi3EnterContinuousTimeMode, INSTANCE)
REFUSED(fmi3CompletedIntegratorStep, INSTANCE, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
        fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation)
REFUSED(fmi3SetTime, INSTANCE, fmi3Float64 time)
REFUSED(fmi3SetContinuousStates, INSTANCE, const fmi3Float64 continuousStates[], size_t nContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives, INSTANCE, fmi3Float64 derivatives[], size_t nContinuousStates)
REFUSED(fmi3GetEventIndicators, INSTANCE, fmi3Float64 eventIndicators[], size_t nEventIndicators)
REFUSED(fmi3GetContinuousStates, INSTANCE, fmi3Float64 continuousStates[], size_t nContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates, INSTANCE, fmi3Float64 nominals[], size_t nContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators, INSTANCE, size_t *nEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates, INSTANCE, size_t *nContinuousStates)
REFUSED(fmi3ActivateModelPartition, INSTANCE, fmi3ValueReference clockReference, fmi3Float64 activationTime)

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
  return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String instantiationToken,
                                               fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                               fmi3InstanceEnvironment instanceEnvironment,
                                               fmi3LogMessageCallback logMessage,
                                               fmi3ClockUpdateCallback clockUpdate,
                                               fmi3LockPreemptionCallback lockPreemption,
                                               fmi3UnlockPreemptionCallback unlockPreemption) {
  return NULL;
}
