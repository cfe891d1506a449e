/* Shared by the app's files: the memory of the flight core, its log variables, and the calls between tasks. */
#pragma once

#include <stdbool.h>

#include "crtp.h"

#include "floaty_core.h"
#include "floaty_wire.h"

/* A pose for the stabilizer task. */
typedef struct {
  int32_t arrival_us; /* wraps */
  float position[3];   /* [m] */
  float quaternion[4]; /* w x y z */
  int32_t age_us;      /* at arrival; negative: the sender does not know */
} FloatyPose;

/* The app's own observations. */
typedef struct {
  volatile int32_t followed; /* result of the stock commander's last set-point, FLOATY_SETPOINT_... */
  uint32_t malformed;        /* malformed packets on the pose channels */
  uint32_t overflows;        /* poses dropped from a full queue for a newer one */
  uint32_t stale_hovers;     /* times without control, after which the servos were set to hover */
  int32_t too_old;           /* poses older than every horizon */
  int32_t too_old_us;        /* age of the last of them */
  float no_correction[3];    /* [m] place of the last pose that was too far from the goal for a correction */
} FloatyObserved;

extern FloatyParameters floaty_parameters;
extern FloatyInput floaty_input;
extern FloatyEstimator floaty_estimator;
extern FloatyControl floaty_control;
extern FloatySampling floaty_sampling;
extern FloatySupervisor floaty_supervisor;
extern FloatyReport floaty_report;
extern FloatyObserved floaty_observed;

/* Requests of other tasks to the stabilizer task, the only one that calls the flying core: by FLOATY_REQUEST_... */
#define FLOATY_RESET 0 /* restart the estimator */
extern volatile bool floaty_requests[FLOATY_REQUEST_DISARM + 1];

/* floaty_app.c: set up the core and start the servo pulses, at hover. The first call of all. */
void floaty_begin(void);

/* floaty_app.c: read the raw counts of the board's own gyro, zero without a known gyro. */
void floaty_gyro(int32_t counts[3]);

/* floaty_app.c: return the clock of the loop [us]; it wraps, and stops while the flight is held. */
int32_t floaty_loop_us(void);

/* floaty_app.c: return the clock for arrivals of poses [us]; it wraps. */
int32_t floaty_pose_clock_us(void);

/* floaty_app.c: queue a pose for the stabilizer task; a full queue drops the oldest one. */
void floaty_queue_pose(const FloatyPose *pose);

/* floaty_app.c: set the servos to hover whatever the stabilizer task does. */
void floaty_hover(void);

/* floaty_toc.c: apply parameters that were read from the EEPROM. */
void floaty_toc_apply(void);

/* floaty_toc.c: print the parameters that differ from the profile on the console. */
void floaty_toc_report(void);

/* floaty_commands.c: refuse high-level commands that cannot be flown, from now on. */
void floaty_commands_init(void);
extern float floaty_commanded[4]; /* last position of the firmware's commander, x y z [m], and yaw [rad] */

/* floaty_servos.c: four outputs at 400 Hz; one count is 1/21 us, a pulse 21000..42000, the period 52501. They start with these
 * pulses; new counts act from the next period on. */
void floaty_servos_init(const int32_t count[4]);
void floaty_servos_write(const int32_t count[4]);

/* floaty_port.c: execute the core call by call for a host, on separate memory, from now on. */
void floaty_port_init(void);

/* floaty_hil.c: hardware in the loop. IMU samples come from a host instead of the sensor, and the board returns its
 * results; its own loop, tasks, radio and supervisor run as always. firmware_py/wire/core_port.py has the packets. */
extern volatile uint8_t floaty_hil_mode;  /* in force, a FLOATY_HIL_... */
extern volatile uint32_t floaty_hil_held; /* steps since the start in which the flight was held: neither steps nor time */

/* Any task: request a mode; it is in force from the next step on. */
void floaty_hil_request(uint8_t mode);

/* The receiving task: take a packet with samples. */
void floaty_hil_receive(const CRTPPacket *packet);

/* The stabilizer task, once per step: return whether the mode has just changed, so that all restarts. */
bool floaty_hil_switched(void);

/* The stabilizer task, once per step: return whether the flight is held, because the host's next sample is missing. */
bool floaty_hil_holds(void);

/* The stabilizer task, once per step of the flight: replace the sensor's sample by the host's, if the mode asks for it.
 * False when it repeats the last one, because the next one is late: the link's fault, not the gyro's. */
bool floaty_hil_sample(int32_t counts[3]);

/* The stabilizer task: report to the host; `fresh`: the controller has just run. */
void floaty_hil_report(bool fresh);
