/* Parameters, like log variables; `type` has flags in its upper half, `extended_type` holds what does not fit. */
#pragma once
#include <stdbool.h>
#include <stdint.h>
typedef struct {
  uint16_t id;
  uint16_t index;
} __attribute__((packed)) paramVarId_t;
paramVarId_t paramGetVarId(const char *, const char *);
int paramGetInt(paramVarId_t);
struct param_s {
  uint8_t type;
  uint8_t extended_type;
  char *name;
  void *address;
  void (*callback)(void);
  void *(*getter)(void);
};
#define PARAM_UINT8 0x08
#define PARAM_UINT16 0x09
#define PARAM_INT16 0x01
#define PARAM_INT32 0x02
#define PARAM_FLOAT 0x06
#define PARAM_GROUP (0x01 << 7)
#define PARAM_EXTENDED (1 << 4)
#define PARAM_PERSISTENT (1 << 8)
#define PARAM_START 1
#define PARAM_STOP 0
#define PARAM_ADD_FULL(TYPE, NAME, ADDRESS, CALLBACK, DEFAULT_GETTER)           \
  {.type = ((TYPE) <= 0xFF) ? ((TYPE)&0xFF) : (((TYPE) | PARAM_EXTENDED) & 0xFF), \
   .extended_type = (((TYPE)&0xFF00) >> 8),                                     \
   .name = #NAME,                                                               \
   .address = (void *)(ADDRESS),                                                \
   .callback = (void (*)(void))CALLBACK,                                        \
   .getter = (void *(*)(void))DEFAULT_GETTER},
#define PARAM_ADD_WITH_CALLBACK(TYPE, NAME, ADDRESS, CALLBACK) PARAM_ADD_FULL(TYPE, NAME, ADDRESS, CALLBACK, 0)
#define PARAM_ADD_GROUP(TYPE, NAME, ADDRESS) PARAM_ADD_FULL(TYPE, NAME, ADDRESS, 0, 0)
#ifdef __arm__
#define PARAM_PLACE(NAME) section(".param." #NAME), used
#else
#define PARAM_PLACE(NAME) section("param_table"), used, aligned(sizeof(void *))
#endif
#define PARAM_GROUP_START(NAME)                                              \
  static struct param_s __params_##NAME[] __attribute__((PARAM_PLACE(NAME))) = { \
      PARAM_ADD_GROUP(PARAM_GROUP | PARAM_START, NAME, 0x0)
#define PARAM_GROUP_STOP(NAME) PARAM_ADD_GROUP(PARAM_GROUP | PARAM_STOP, stop_##NAME, 0x0) };
