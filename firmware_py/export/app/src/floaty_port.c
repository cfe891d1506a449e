/* The core, call by call for a host: see floaty_app.h.
 *
 * The task CRTP-RX receives requests and executes them, on separate memory, and only while the robot
 * is at rest. A call is measured with the scheduler suspended, 1.2 ms at most: no other task runs meanwhile, interrupts
 * do. So no call is executed with hardware in the loop, whose flight it would delay.
 */
#include "floaty_calls.h"

#include <string.h>

#include "FreeRTOS.h"
#include "task.h"

#include "crc32.h"
#include "crtp.h"
#include "pm.h"
#include "stm32fxxx.h"

#define CLOCK_MHZ 168

_Static_assert(sizeof FLOATY_CORE_VERSION > FLOATY_NAME_SIZE, "the core's hash");
_Static_assert(sizeof(FloatyMemory) <= UINT16_MAX, "offsets have 16 bits");

static FloatyMemory memory;
static uint8_t session;           /* 0: none */
static uint16_t done;             /* requests of the session that were executed */
static uint16_t last_call;        /* number of the last call */
static FloatyWireCalled called;   /* and its answer */

static uint8_t hello(uint8_t wanted, uint8_t *body) {
  FloatyWireAbout about = {FLOATY_VERSION, (uint8_t)floaty_supervisor.state, sizeof memory, 0, CLOCK_MHZ, "", ""};
  if (wanted != session) {
    session = wanted;
    done = 0;
    memset(&memory, 0, sizeof memory);
    CoreDebug->DEMCR |= CoreDebug_DEMCR_TRCENA_Msk;
    DWT->CTRL |= DWT_CTRL_CYCCNTENA_Msk;
  }
  about.done = done;
  memcpy(about.core, FLOATY_CORE_VERSION, sizeof about.core);
  memcpy(about.profile, floaty_profile_hash, sizeof about.profile);
  memcpy(body, &about, sizeof about);
  return sizeof about;
}

static void execute(uint8_t entry) {
  vTaskSuspendAll();
  const uint32_t begin = DWT->CYCCNT;
  called.answer = (int8_t)call_on(&memory, entry);
  called.cycles = DWT->CYCCNT - begin;
  xTaskResumeAll();
  called.digest = crc32CalculateBuffer(&memory, sizeof memory);
}

/* Handlers of requests return the size of the answer, NO_ANSWER, or the refusal. */
#define NO_ANSWER (-1)
#define REFUSED(REASON) (-1 - FLOATY_REFUSAL_##REASON)

/* Return whether a piece is inside the memory. */
static bool inside(uint32_t offset, uint32_t size) {
  return offset + size <= sizeof memory;
}

static int write_memory(const uint8_t *data, uint32_t length, bool is_new) {
  FloatyWirePlace place;
  if (length < sizeof place) {
    return REFUSED(OUTSIDE);
  }
  memcpy(&place, data, sizeof place);
  length -= sizeof place;
  if (!inside(place.offset, length)) {
    return REFUSED(OUTSIDE);
  }
  if (is_new) {
    memcpy((uint8_t *)&memory + place.offset, data + sizeof place, length);
  }
  return 0;
}

static int read_memory(const uint8_t *data, uint32_t length, uint8_t *body) {
  FloatyWirePlaceSize place;
  if (length < sizeof place) {
    return REFUSED(OUTSIDE);
  }
  memcpy(&place, data, sizeof place);
  if (place.size > FLOATY_READ_MAX || !inside(place.offset, place.size)) {
    return REFUSED(OUTSIDE);
  }
  memcpy(body, (const uint8_t *)&memory + place.offset, place.size);
  return place.size;
}

static int call(const uint8_t *data, uint32_t length, uint16_t number, bool is_new, uint8_t *body) {
  if (length < sizeof(FloatyWireCall) || data[0] >= FLOATY_CALLS) {
    return REFUSED(OUTSIDE);
  }
  if (is_new) {
    execute(data[0]);
    last_call = number;
  } else if (number != last_call) {
    return NO_ANSWER; /* an old duplicate */
  }
  memcpy(body, &called, sizeof called);
  return sizeof called;
}

static int loop(const uint8_t *data, uint32_t length, bool is_new) {
  if (length < sizeof(FloatyWireMode) || data[0] > FLOATY_HIL_MOVING) {
    return REFUSED(OUTSIDE);
  }
  if (is_new) {
    floaty_hil_request(data[0]);
  }
  return 0;
}

static int health(uint8_t *body) {
  int32_t gyro[3];
  floaty_gyro(gyro);
  const FloatyWireHealth answer = {
      .gyro_x = (int16_t)gyro[0],
      .gyro_y = (int16_t)gyro[1],
      .gyro_z = (int16_t)gyro[2],
      .battery_mv = (uint16_t)(1000.0f * pmGetBatteryVoltage()),
      .heap_free = (uint32_t)xPortGetFreeHeapSize(),
      FLOATY_HEALTH_OF_CORE,
  };
  memcpy(body, &answer, sizeof answer);
  return sizeof answer;
}

static int serve(const FloatyWireHead *head, const uint8_t *data, uint32_t length, uint8_t *body) {
  const int16_t ahead = (int16_t)(head->number - done);
  const bool is_new = ahead == 0;
  int size;
  if (head->kind == FLOATY_MESSAGE_HELLO && head->session != 0) {
    return hello(head->session, body);
  }
  if (head->session != session || session == 0) {
    return REFUSED(NO_SESSION);
  }
  const bool in_the_loop = floaty_hil_mode != FLOATY_HIL_OFF;
  if (!in_the_loop && floaty_supervisor.aloft && head->kind != FLOATY_MESSAGE_HEALTH) {
    return REFUSED(FLYING);
  }
  if (in_the_loop && head->kind == FLOATY_MESSAGE_CALL) {
    return REFUSED(LOOP);
  }
  if (ahead > 0) {
    return NO_ANSWER; /* an earlier one was lost: the host repeats both */
  }
  switch (head->kind) {
    case FLOATY_MESSAGE_WRITE: size = write_memory(data, length, is_new); break;
    case FLOATY_MESSAGE_READ: size = read_memory(data, length, body); break;
    case FLOATY_MESSAGE_HEALTH: size = health(body); break;
    case FLOATY_MESSAGE_LOOP: size = loop(data, length, is_new); break;
    case FLOATY_MESSAGE_CALL: size = call(data, length, head->number, is_new, body); break;
    default: return REFUSED(OUTSIDE);
  }
  if (is_new && size >= 0) {
    done += 1;
  }
  return size;
}

static void receive(CRTPPacket *packet) {
  static CRTPPacket answer;
  FloatyWireHead head;
  uint8_t *body = answer.data + sizeof head;
  if (packet->channel == FLOATY_CHANNEL_LOOP) {
    floaty_hil_receive(packet);
    return;
  }
  if (packet->channel != FLOATY_CHANNEL_CALLS || packet->size < sizeof head) {
    return;
  }
  memcpy(&head, packet->data, sizeof head);
  int size = serve(&head, packet->data + sizeof head, packet->size - sizeof head, body);
  if (size == NO_ANSWER) {
    return;
  }
  if (size < 0) {
    const FloatyWireWhy why = {(uint8_t)(NO_ANSWER - size)};
    head.kind = FLOATY_MESSAGE_REFUSED;
    memcpy(body, &why, sizeof why);
    size = sizeof why;
  }
  memcpy(answer.data, &head, sizeof head);
  answer.port = FLOATY_PORT_CORE;
  answer.channel = FLOATY_CHANNEL_CALLS;
  answer.size = (uint8_t)(sizeof head + (uint32_t)size);
  crtpSendPacket(&answer); /* lost when the queue is full: the host asks again */
}

void floaty_port_init(void) {
  crtpRegisterPortCB(FLOATY_PORT_CORE, receive);
}
