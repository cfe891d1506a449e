#pragma once
#include "autoconf.h"
#include "stabilizer_types.h"
typedef struct {
  uint32_t opaque[12];
} measurement_t;
typedef enum {
  StateEstimatorTypeAutoSelect = 0,
  StateEstimatorTypeOutOfTree = 3, /* after Kalman, which is built by default */
} StateEstimatorType;
StateEstimatorType stateEstimatorGetType(void);
bool estimatorDequeue(measurement_t *);
void estimatorOutOfTreeInit(void);
bool estimatorOutOfTreeTest(void);
void estimatorOutOfTree(state_t *, stabilizerStep_t);
