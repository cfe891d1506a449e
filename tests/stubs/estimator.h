#pragma once
#include "autoconf.h"
#include "stabilizer_types.h"
typedef enum { MeasurementTypePose = 2, MeasurementTypeGyroscope = 9 } MeasurementType;
typedef struct {
  MeasurementType type;
  union {
    poseMeasurement_t pose;
  } data;
} measurement_t;
typedef enum {
  StateEstimatorTypeAutoSelect = 0,
  StateEstimatorTypeComplementary,
  StateEstimatorTypeKalman,
  StateEstimatorTypeOutOfTree,
} StateEstimatorType;
StateEstimatorType stateEstimatorGetType(void);
bool estimatorDequeue(measurement_t *measurement);
void estimatorOutOfTreeInit(void);
bool estimatorOutOfTreeTest(void);
void estimatorOutOfTree(state_t *state, const stabilizerStep_t stabilizerStep);
