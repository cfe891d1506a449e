/* What the files of the app share: the memory of the flight core, what is logged of it, and who asks whom for what. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "floaty_core.h"

/* A pose on its way to the stabilizer task. */
typedef struct {
  int32_t arrival_us; /* wraps */
  float position[3];   /* [m] */
  float quaternion[4]; /* w x y z */
  int32_t age_us;      /* at arrival; negative: the sender does not know */
} FloatyPose;

/* What the app counts itself. */
typedef struct {
  uint32_t malformed;     /* packets on the pose channels that no one could read */
  uint32_t overflows;     /* poses that a newer one drove out of the full queue */
  uint32_t stale_hovers;  /* times no controller step came and the servos were put to hover */
} FloatyObserved;

extern FloatyParameters floaty_parameters;
extern FloatyInput floaty_input;
extern FloatyEstimator floaty_estimator;
extern FloatyControl floaty_control;
extern FloatySampling floaty_sampling;
extern FloatySupervisor floaty_supervisor;
extern FloatyReport floaty_report;
extern FloatyObserved floaty_observed;

/* What other tasks ask of the stabilizer task, which alone touches the supervisor's instants and the estimator. */
typedef struct {
  volatile bool stop;          /* emergency stop */
  volatile bool recover;       /* leave it */
  volatile bool arm;
  volatile bool disarm;
  volatile bool reset; /* start the estimator afresh */
} FloatyRequests;

extern FloatyRequests floaty_requests;

/* floaty_app.c: sets the core up and lets the servos pulse, at hover. The first call of all. */
void floaty_begin(void);

/* floaty_app.c: the raw counts of the board's own gyro, zero where there is none that is known. */
void floaty_gyro(int32_t counts[3]);

/* floaty_app.c: what became of the stock commander's last set-point, FLOATY_SETPOINT_... */
int32_t floaty_followed(void);

/* floaty_app.c: the clock by which poses arrive [us]; it wraps. */
int32_t floaty_pose_clock_us(void);

/* floaty_app.c: hands a pose to the stabilizer task; when the queue is full the oldest one goes. */
void floaty_queue_pose(const FloatyPose *pose);

/* floaty_app.c: puts the servos to hover whatever the stabilizer task does. */
void floaty_hover(void);

/* floaty_app.c: the same, and the state says that nobody controls. */
void floaty_lose_control(void);

/* floaty_app.c: the tick of the last controller step; 0: none yet. */
uint32_t floaty_controlled_tick(void);

/* floaty_toc.c: brings parameters that were read from the EEPROM into force. */
void floaty_toc_apply(void);

/* floaty_toc.c: says on the console which parameters are not as in the profile. */
void floaty_toc_report(void);
