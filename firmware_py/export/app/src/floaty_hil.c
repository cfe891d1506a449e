/* Hardware in the loop: see floaty_app.h.
 *
 * Samples wait in a buffer that one task fills and another empties. Each variable is written by one task only: the
 * receiving task begins a new stream when the stabilizer task has begun another mode, and the stabilizer task reads
 * only the stream of its mode. The first sample is taken when enough of them wait to cover the link's jitter; the
 * host paces its clock to keep about as many waiting.
 */
#include "floaty_calls.h"

#include <string.h>

#define AXES 3
#define BUFFER 64         /* samples; a power of two, so that it divides 65536, and more than a host has in flight */
#define SILENT_STEPS 1000 /* without a sample the mode ends */
#define REPORT_STEPS 10     /* while the flight is held */

typedef struct {
  int16_t counts[AXES];
} Sample;

static volatile uint8_t wanted;
static Sample buffer[BUFFER];

/* Of the receiving task */
static uint16_t first;             /* number of the stream's first sample */
static volatile uint16_t received; /* samples of the stream */
static volatile uint16_t lost, doubled;
static uint16_t gap;               /* `received` when the last sample out of sequence arrived */
static volatile uint8_t stream;    /* value of `modes` at the stream's start; written last */

/* Of the stabilizer task */
volatile uint8_t floaty_hil_mode;
static volatile uint8_t modes;     /* begun so far */
static volatile uint16_t used;     /* samples taken of the stream */
static Sample taken;               /* last */
static uint16_t late;              /* steps that took the last sample again */
volatile uint32_t floaty_hil_held;
static uint32_t held_before;       /* this mode */
static uint16_t silent_steps;
static bool running;               /* samples are taken */

void floaty_hil_request(uint8_t asked) {
  silent_steps = 0;
  wanted = asked;
}

/* Take only the next sample: the host repeats a missing one and all after it. */
static bool put(uint16_t number, const Sample *sample) {
  const int16_t ahead = (int16_t)(number - first - received);
  if (ahead < 0) {
    doubled += 1;
    return true;
  }
  if (ahead > 0 || (uint16_t)(received - used) >= BUFFER) {
    if (gap != received) {
      lost += (uint16_t)ahead;
      gap = received;
    }
    return false;
  }
  buffer[received % BUFFER] = *sample;
  received += 1;
  return true;
}

/* Advance a sample to the next one. */
static void advance(Sample *sample, const uint8_t *step, uint8_t width) {
  Sample difference;
  if (width == FLOATY_WIDE) {
    memcpy(&difference, step, sizeof difference);
  } else {
    uint32_t word;
    memcpy(&word, step, sizeof word);
    for (int axis = 0; axis < AXES; axis++, word >>= FLOATY_NARROW_BITS) {
      const int32_t bits = (int32_t)(word & ((1U << FLOATY_NARROW_BITS) - 1U));
      const int32_t sign = 1 << (FLOATY_NARROW_BITS - 1);
      difference.counts[axis] = (int16_t)((bits ^ sign) - sign);
    }
  }
  for (int axis = 0; axis < AXES; axis++) {
    sample->counts[axis] = (int16_t)(sample->counts[axis] + difference.counts[axis]);
  }
}

void floaty_hil_receive(const CRTPPacket *packet) {
  FloatyWireSamples head;
  if (floaty_hil_mode == FLOATY_HIL_OFF || packet->size < sizeof head) {
    return;
  }
  memcpy(&head, packet->data, sizeof head);
  if (head.width != FLOATY_NARROW && head.width != FLOATY_WIDE) {
    return;
  }
  const uint8_t present = modes;
  if (stream != present) {
    first = head.number;
    received = lost = doubled = 0;
    gap = UINT16_MAX;
    stream = present;
  }
  Sample sample = {{head.x, head.y, head.z}};
  const uint8_t *step = packet->data + sizeof head;
  const uint8_t *end = packet->data + packet->size;
  for (uint16_t number = head.number; put(number, &sample) && step + head.width <= end; number++) {
    advance(&sample, step, head.width);
    step += head.width;
  }
}

bool floaty_hil_switched(void) {
  if (floaty_hil_mode != FLOATY_HIL_OFF && silent_steps >= SILENT_STEPS) {
    wanted = FLOATY_HIL_OFF;
  }
  if (floaty_hil_mode == wanted) {
    return false;
  }
  used = late = silent_steps = 0;
  held_before = floaty_hil_held;
  running = false;
  floaty_hil_mode = wanted;
  modes += 1;
  return true;
}

bool floaty_hil_holds(void) {
  const uint16_t waiting = stream == modes ? (uint16_t)(received - used) : 0;
  if (floaty_hil_mode == FLOATY_HIL_OFF) {
    return false;
  }
  running = running || waiting >= FLOATY_HIL_WAITING;
  if (running && waiting > 0) {
    silent_steps = 0;
    return false;
  }
  silent_steps += 1;
  if (running && silent_steps > FLOATY_HIL_HOLD) {
    return false;
  }
  floaty_hil_held += 1;
  if (silent_steps % REPORT_STEPS == 0) {
    floaty_hil_report(false);
  }
  return true;
}

bool floaty_hil_sample(int32_t counts[3]) {
  if (floaty_hil_mode == FLOATY_HIL_OFF) {
    return true;
  }
  const bool fresh = silent_steps == 0;
  if (fresh) {
    taken = buffer[used % BUFFER];
    used += 1;
  } else {
    late += 1;
  }
  for (int axis = 0; axis < AXES; axis++) {
    counts[axis] = taken.counts[axis];
  }
  return fresh;
}

void floaty_hil_report(bool fresh) {
  CRTPPacket packet;
  if (floaty_hil_mode == FLOATY_HIL_OFF) {
    return;
  }
  const bool current = stream == modes; /* a sample of this mode */
  const FloatyWireLoop loop = {
      .used = current ? (uint16_t)(first + used) : 0,
      .waiting = current ? (uint8_t)(received - used) : 0,
      .fresh = fresh,
      .held = (uint16_t)(floaty_hil_held - held_before),
      .late = late,
      .lost = current ? lost : 0,
      .doubled = current ? doubled : 0,
      FLOATY_LOOP_OF_CORE,
  };
  memset(&packet, 0, sizeof packet);
  packet.port = FLOATY_PORT_CORE;
  packet.channel = FLOATY_CHANNEL_LOOP;
  packet.size = sizeof loop;
  memcpy(packet.data, &loop, sizeof loop);
  crtpSendPacket(&packet);
}
