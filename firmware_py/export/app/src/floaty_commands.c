/* High-level commands that the firmware would not refuse, although it cannot fly them: see floaty_app.h.
 *
 * The firmware plans a command with NaN or without the time for its path, gets no set-points from it, and locks itself two
 * seconds later. It plans a command that is too short from what the buffer holds, and begins a path that leaves the box.
 *
 * The task CRTP-RX puts a packet of port 8 into the queue of the firmware's commander and then calls us: a command that is
 * refused is taken back and answered here. Both tasks have the same priority. When the commander has been faster, or when
 * numbers in the trajectory memory are not finite, floaty_app.c ends the path.
 */
#define DEBUG_MODULE "FLOATY"

#include "floaty_calls.h"

#include <errno.h>
#include <math.h>
#include <string.h>

#include "FreeRTOS.h"
#include "task.h"

#include "commander.h"
#include "crtp.h"
#include "crtp_commander_high_level.h"
#include "debug.h"
#include "planner.h"

#define COMMANDS 14
#define STATUS 3 /* byte of the answer */
#define QUEUED 4 /* commands that may wait, one but for bursts */
#define TURN 6.28318531f

enum { TAKE_OFF_1 = 1, LAND_1, STOP, GO_TO_1, START_1, DEFINE, TAKE_OFF, LAND, TAKE_OFF_BY_SPEED, LAND_BY_SPEED, SPIRAL, GO_TO, START };

/* Size of a command, and where its float32 are: firmware_py/wire/high_level.py. */
static const struct {
  uint8_t size, floats, first, last; /* the last is apart from the others when it does not follow them */
} FORMS[COMMANDS] = {
    [0] = {2, 0, 0, 0},           [TAKE_OFF_1] = {10, 2, 2, 0},         [LAND_1] = {10, 2, 2, 0},
    [STOP] = {2, 0, 0, 0},        [GO_TO_1] = {23, 5, 3, 0},            [START_1] = {9, 1, 5, 0},
    [DEFINE] = {9, 0, 0, 0},      [TAKE_OFF] = {15, 2, 2, 11},          [LAND] = {15, 2, 2, 11},
    [SPIRAL] = {24, 5, 4, 0},     [TAKE_OFF_BY_SPEED] = {16, 1, 2, 12}, [LAND_BY_SPEED] = {16, 1, 2, 12},
    [GO_TO] = {24, 5, 4, 0},      [START] = {10, 1, 6, 0},
};

float floaty_commanded[4];

static float number(const uint8_t *at) {
  float value;
  memcpy(&value, at, sizeof value);
  return value;
}

static bool finite_numbers(const uint8_t *data) {
  const uint8_t command = data[0];
  for (int i = 0; i < FORMS[command].floats; i++) {
    if (!isfinite(number(data + FORMS[command].first + 4 * i))) {
      return false;
    }
  }
  if (command == TAKE_OFF_BY_SPEED || command == LAND_BY_SPEED) {
    if (!isfinite(number(data + 7))) {
      return false; /* the yaw */
    }
  }
  return FORMS[command].last == 0 || isfinite(number(data + FORMS[command].last));
}

static bool has_time(const uint8_t *data) {
  switch (data[0]) {
    case GO_TO: return data[3] == 0 || number(data + 20) > 0.0f; /* linear */
    case SPIRAL: return number(data + 20) > 0.0f;
    case START_1: return number(data + 5) > 0.0f;
    case START: return number(data + 6) > 0.0f;
    default: return true;
  }
}

/* The last set-point of the firmware's commander if it flies, else the estimate: x, y, z [m] and yaw [rad]. */
static void begin_of_path(float place[4]) {
  if (crtpCommanderHighLevelGetPlannerState() & TRAJECTORY_STATE_FLYING) {
    memcpy(place, floaty_commanded, 4 * sizeof *place);
  } else {
    memcpy(place, floaty_report.position, 3 * sizeof *place);
    place[3] = floaty_report.attitude[2];
  }
}

static float kept(float value, float low, float high) {
  return fminf(fmaxf(value, low), high);
}

/* Move from the begin to the end of a spiral: the centre is seen along the yaw, or to the right of it. */
static void end_of_spiral(const uint8_t *data, float place[4]) {
  const float sense = data[3] ? 1.0f : -1.0f, angle = kept(number(data + 4), -TURN, TURN);
  const float first = fmaxf(number(data + 8), 0.0f), last = fmaxf(number(data + 12), 0.0f);
  const float from = place[3] - (data[2] ? 0.0f : TURN / 4.0f), to = from - sense * angle;
  place[0] += sense * (first * cosf(from) - last * cosf(to));
  place[1] += sense * (first * sinf(from) - last * sinf(to));
  place[2] += number(data + 16);
}

/* Return whether a command ends a path somewhere, and move the place there. */
static bool end_of_path(const uint8_t *data, float place[4]) {
  const uint8_t *xyz = data + (data[0] == GO_TO ? 4 : 3);
  const float height = number(data + 2);
  switch (data[0]) {
    case GO_TO:
    case GO_TO_1:
      for (int axis = 0; axis < 3; axis++) {
        place[axis] = number(xyz + 4 * axis) + (data[2] ? place[axis] : 0.0f);
      }
      return true;
    case SPIRAL: end_of_spiral(data, place); return true;
    case TAKE_OFF_BY_SPEED: place[2] = data[6] ? place[2] + height : height; return true;
    case LAND_BY_SPEED: place[2] = data[6] ? place[2] - height : height; return true;
    case TAKE_OFF_1:
    case TAKE_OFF:
    case LAND_1:
    case LAND: place[2] = height; return true;
    default: return false;
  }
}

static bool ends_in_the_box(const uint8_t *data) {
  static FloatyInput candidate; /* without a goal the core asks for the box itself */
  float place[4];
  if (!floaty_input.absolute || commanderGetActivePriority() > COMMANDER_PRIORITY_HIGHLEVEL) {
    return true; /* the path is not followed */
  }
  begin_of_path(place);
  if (!end_of_path(data, place)) {
    return true;
  }
  candidate.poses_absolute = 1;
  memcpy(candidate.setpoint, place, sizeof candidate.setpoint);
  return floaty_core_admits(&floaty_parameters, &candidate) != 0;
}

/* Return why a command cannot be flown; NULL when it can, or when it is the firmware's to refuse. */
static const char *obstacle(const CRTPPacket *packet) {
  const uint8_t *data = packet->data;
  if (packet->size < 1 || data[0] >= COMMANDS) {
    return NULL;
  }
  if (packet->size != FORMS[data[0]].size) {
    return "wrong size";
  }
  if (!finite_numbers(data)) {
    return "not finite";
  }
  if (!has_time(data)) {
    return "no time for it";
  }
  return ends_in_the_box(data) ? NULL : "it leaves the box";
}

static void refuse(CRTPPacket *packet, uint8_t status) {
  packet->data[STATUS] = status;
  packet->size = STATUS + 1;
  crtpSendPacket(packet);
}

static void check_command(CRTPPacket *packet) {
  static CRTPPacket taken[QUEUED];
  int count = 0;
  vTaskSuspendAll(); /* the commander has the same priority and would get its turn after any interruption */
  const char *why = obstacle(packet);
  while (why != NULL && count < QUEUED && crtpReceivePacket(CRTP_PORT_SETPOINT_HL, &taken[count]) == pdTRUE) {
    count += 1;
  }
  xTaskResumeAll();
  if (why == NULL) {
    taskYIELD(); /* the commander takes it before the next one comes */
    return;
  }
  for (int i = 0; i < count; i++) { /* those before the last still waited */
    refuse(&taken[i], i == count - 1 ? ENOEXEC : EBUSY);
  }
  DEBUG_PRINT("command %d refused: %s\n", packet->data[0], why);
}

void floaty_commands_init(void) {
  crtpRegisterPortCB(CRTP_PORT_SETPOINT_HL, check_command);
}
