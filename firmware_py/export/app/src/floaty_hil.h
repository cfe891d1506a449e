/* Hardware in the loop: IMU samples come from a host instead of the sensor, and what the board makes of them goes back.
 *
 * The board's own loop, tasks, radio and supervisor run as always. firmware_py/wire/core_port.py has the packets.
 */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "crtp.h"
#include "stabilizer_types.h"

/* Any task: asks for a mode, a FLOATY_HIL_...; it is there from the next step on. */
void floaty_hil_ask(uint8_t mode);

/* The mode that is in force. */
uint8_t floaty_hil_mode(void);

/* The receiving task: takes a packet with samples. */
void floaty_hil_receive(const CRTPPacket *packet);

/* The stabilizer task, once per step: whether the mode has just changed, and everything begins afresh. */
bool floaty_hil_switched(void);

/* The stabilizer task, once per step: whether the flight stands still in it, because the host's next sample is not there. */
bool floaty_hil_holds(void);

/* Any task: for how many steps the flight has stood still since the start. They count neither as steps nor as time. */
uint32_t floaty_hil_held(void);

/* The stabilizer task, once per step of the flight: puts the host's sample in place of the sensor's, if the mode asks for it.
 * False when that is the last one again, because the next one is late: the link's fault, not the gyro's. */
bool floaty_hil_sample(int32_t counts[3]);

/* The stabilizer task: tells the host; `fresh`: the controller has just run. */
void floaty_hil_tell(bool fresh);
