/* See floaty_hil.h.
 *
 * Samples wait in a buffer that one task fills and another empties, each with a counter of its own. The first one is taken
 * when enough of them wait for the link's jitter; the host keeps its clock so that about as many go on waiting.
 */
#include "floaty_hil.h"

#include <string.h>

#include "floaty_app.h"
#include "floaty_wire.h"

#define BUFFER 64       /* samples; a power of two, of which 65536 is a multiple */
#define WAITING_MAX 32 /* samples: more would only make the loop slower */
#define SILENT_STEPS 1000 /* without a sample the mode ends */

typedef struct {
  int16_t counts[3];
} Sample;

static volatile uint8_t wanted;
static uint8_t mode;
static Sample buffer[BUFFER];
static volatile uint16_t received; /* number of the next sample to come */
static volatile uint16_t used;     /* number of the next one to take */
static volatile uint16_t lost, doubled;
static Sample newest;              /* that came */
static Sample taken;               /* last */
static uint16_t late;              /* steps for which no sample was there */
static uint16_t silent_steps;
static volatile bool begun;        /* a first sample has come */
static bool running;               /* samples are taken */

void floaty_hil_ask(uint8_t asked) {
  silent_steps = 0;
  wanted = asked;
}

uint8_t floaty_hil_mode(void) {
  return mode;
}

static void put(const Sample *sample) {
  buffer[received % BUFFER] = *sample;
  received += 1;
}

void floaty_hil_receive(const CRTPPacket *packet) {
  FloatyWireSamples head;
  if (mode == FLOATY_HIL_OFF || packet->size < sizeof head) {
    return;
  }
  memcpy(&head, packet->data, sizeof head);
  if (!begun) {
    received = used = head.number;
    begun = true;
  }
  const uint32_t count = (packet->size - sizeof head) / sizeof(Sample);
  for (uint32_t i = 0; i < count; i++) {
    int16_t ahead = (int16_t)(head.number + i - received);
    if (ahead < 0) {
      doubled += 1;
      continue;
    }
    lost += (uint16_t)ahead;
    if (ahead > BUFFER) {
      received += (uint16_t)(ahead - BUFFER);
      ahead = BUFFER;
    }
    for (; ahead > 0; ahead--) {
      put(&newest); /* time goes on without it */
    }
    memcpy(&newest, packet->data + sizeof head + i * sizeof newest, sizeof newest);
    put(&newest);
  }
}

bool floaty_hil_switched(void) {
  if (mode != FLOATY_HIL_OFF && silent_steps >= SILENT_STEPS) {
    wanted = FLOATY_HIL_OFF;
  }
  if (mode == wanted) {
    return false;
  }
  received = used = lost = doubled = late = silent_steps = 0;
  memset(&newest, 0, sizeof newest);
  memset(&taken, 0, sizeof taken);
  running = begun = false;
  mode = wanted;
  return true;
}

void floaty_hil_sample(int32_t counts[3]) {
  if (mode == FLOATY_HIL_OFF) {
    return;
  }
  uint16_t waiting = (uint16_t)(received - used);
  if (waiting > WAITING_MAX) { /* the newest ones count */
    lost += (uint16_t)(waiting - FLOATY_HIL_WAITING);
    waiting = FLOATY_HIL_WAITING;
    used = (uint16_t)(received - waiting);
  }
  running = running || waiting >= FLOATY_HIL_WAITING;
  silent_steps += 1;
  if (running && waiting > 0) {
    taken = buffer[used % BUFFER];
    used += 1;
    silent_steps = 0;
  } else if (running) {
    late += 1;
  }
  for (int axis = 0; axis < 3; axis++) {
    counts[axis] = taken.counts[axis];
  }
}

void floaty_hil_tell(void) {
  CRTPPacket packet;
  if (mode == FLOATY_HIL_OFF) {
    return;
  }
  const FloatyWireLoop loop = {
      .used = used,
      .waiting = (uint8_t)(received - used),
      .state = floaty_supervisor.state,
      .cause = floaty_supervisor.cause,
      .late = late,
      .lost = lost,
      .doubled = doubled,
      .m1 = (uint16_t)floaty_control.count[0],
      .m2 = (uint16_t)floaty_control.count[1],
      .m3 = (uint16_t)floaty_control.count[2],
      .m4 = (uint16_t)floaty_control.count[3],
      .fused = (uint16_t)floaty_estimator.fused,
      .refused = (uint16_t)floaty_estimator.refused,
      .age = floaty_observed.age,
  };
  memset(&packet, 0, sizeof packet);
  packet.port = FLOATY_PORT_CORE;
  packet.channel = FLOATY_CHANNEL_LOOP;
  packet.size = sizeof loop;
  memcpy(packet.data, &loop, sizeof loop);
  crtpSendPacket(&packet);
}
