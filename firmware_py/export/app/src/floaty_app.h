/* What the files of the app share: the memory of the flight core, what is logged of it, and who asks whom for what. */
#pragma once

#include <stdbool.h>

#include "crtp.h"

#include "floaty_core.h"
#include "floaty_wire.h"

/* A pose on its way to the stabilizer task. */
typedef struct {
  int32_t arrival_us; /* wraps */
  float position[3];   /* [m] */
  float quaternion[4]; /* w x y z */
  int32_t age_us;      /* at arrival; negative: the sender does not know */
} FloatyPose;

/* What the app observes itself. */
typedef struct {
  volatile int32_t followed; /* what became of the stock commander's last set-point, FLOATY_SETPOINT_... */
  uint32_t malformed;        /* packets on the pose channels that no one could read */
  uint32_t overflows;        /* poses that a newer one drove out of the full queue */
  uint32_t stale_hovers;     /* times nobody controlled and the servos were put to hover */
} FloatyObserved;

extern FloatyParameters floaty_parameters;
extern FloatyInput floaty_input;
extern FloatyEstimator floaty_estimator;
extern FloatyControl floaty_control;
extern FloatySampling floaty_sampling;
extern FloatySupervisor floaty_supervisor;
extern FloatyReport floaty_report;
extern FloatyObserved floaty_observed;

/* What other tasks ask of the stabilizer task, which alone enters the core that flies: by FLOATY_REQUEST_... */
#define FLOATY_RESET 0 /* start the estimator afresh */
extern volatile bool floaty_requests[FLOATY_REQUEST_FEED];

/* floaty_app.c: sets the core up and lets the servos pulse, at hover. The first call of all. */
void floaty_begin(void);

/* floaty_app.c: the raw counts of the board's own gyro, zero where there is none that is known. */
void floaty_gyro(int32_t counts[3]);

/* floaty_app.c: the clock of the loop [us]; it wraps, and stands still while the flight does. */
int32_t floaty_loop_us(void);

/* floaty_app.c: the clock by which poses arrive [us]; it wraps. */
int32_t floaty_pose_clock_us(void);

/* floaty_app.c: hands a pose to the stabilizer task; when the queue is full the oldest one goes. */
void floaty_queue_pose(const FloatyPose *pose);

/* floaty_app.c: puts the servos to hover whatever the stabilizer task does. */
void floaty_hover(void);

/* floaty_toc.c: brings parameters that were read from the EEPROM into force. */
void floaty_toc_apply(void);

/* floaty_toc.c: says on the console which parameters are not as in the profile. */
void floaty_toc_report(void);

/* floaty_servos.c: four outputs at 400 Hz; one count is 1/21 us, a pulse 21000..42000, the period 52501. They start with these
 * pulses; what is written acts from the next period on. */
void floaty_servos_init(const int32_t count[4]);
void floaty_servos_write(const int32_t count[4]);

/* floaty_port.c: executes the core call by call for a host, on memory of its own, from now on. */
void floaty_port_init(void);

/* floaty_hil.c: hardware in the loop. IMU samples come from a host instead of the sensor, and what the board makes of them goes
 * back; its own loop, tasks, radio and supervisor run as always. firmware_py/wire/core_port.py has the packets. */
extern volatile uint8_t floaty_hil_mode;  /* in force, a FLOATY_HIL_... */
extern volatile uint32_t floaty_hil_held; /* steps in which the flight stood still since the start: neither steps nor time */

/* Any task: asks for a mode; it is there from the next step on. */
void floaty_hil_ask(uint8_t mode);

/* The receiving task: takes a packet with samples. */
void floaty_hil_receive(const CRTPPacket *packet);

/* The stabilizer task, once per step: whether the mode has just changed, and everything begins afresh. */
bool floaty_hil_switched(void);

/* The stabilizer task, once per step: whether the flight stands still in it, because the host's next sample is not there. */
bool floaty_hil_holds(void);

/* The stabilizer task, once per step of the flight: puts the host's sample in place of the sensor's, if the mode asks for it.
 * False when that is the last one again, because the next one is late: the link's fault, not the gyro's. */
bool floaty_hil_sample(int32_t counts[3]);

/* The stabilizer task: tells the host; `fresh`: the controller has just run. */
void floaty_hil_tell(bool fresh);
