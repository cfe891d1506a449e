/* What the files of the app share: the memory of the flight core and what is logged of it. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "floaty_core.h"
#include "floaty_supervisor.h"

/* What an observer sees and the core does not hold in this form. */
typedef struct {
  float flap[4];     /* [rad] estimated flap angles */
  uint16_t age;      /* [0.1 ms] of the last pose */
  uint16_t poses;    /* received, modulo 65536 */
  uint16_t rejected; /* of these, refused */
  uint32_t malformed;     /* packets on the pose channels that no one could read */
  uint32_t overflows;     /* poses that found the queue full */
  uint32_t stale_hovers;  /* times the loop stood still and the servos were put to hover */
} FloatyObserved;

extern FloatyParameters floaty_parameters;
extern FloatyInput floaty_input;
extern FloatyEstimator floaty_estimator;
extern FloatyControl floaty_control;
extern FloatySupervisor floaty_supervisor;
extern FloatyObserved floaty_observed;

/* What other tasks ask of the stabilizer task, which alone touches the supervisor's instants and the estimator. */
typedef struct {
  volatile bool stop;          /* emergency stop */
  volatile bool recover;       /* leave it */
  volatile bool feed_watchdog; /* of the emergency stop */
  volatile bool arm;
  volatile bool disarm;
  volatile bool reset; /* start the estimator afresh */
} FloatyRequests;

extern FloatyRequests floaty_requests;

/* Brings parameters that were read from the memory at start into force (floaty_toc.c). */
void floaty_toc_apply(void);
