/* Log variables lie between marks in a section of their own, in tables that begin and end with a group entry. */
#pragma once
#include <stdbool.h>
#include <stdint.h>
typedef uint16_t logVarId_t;
logVarId_t logGetVarId(const char *, const char *);
static inline bool logVarIdIsValid(logVarId_t id) {
  return id != 0xffffu;
}
int logGetInt(logVarId_t);
struct log_s {
  uint8_t type;
  char *name;
  void *address;
};
#define LOG_UINT8 1
#define LOG_UINT16 2
#define LOG_UINT32 3
#define LOG_INT32 6
#define LOG_FLOAT 7
#define LOG_GROUP 0x80
#define LOG_START 1
#define LOG_STOP 0
#define LOG_ADD(TYPE, NAME, ADDRESS) {.type = TYPE, .name = #NAME, .address = (void *)(ADDRESS)},
#define LOG_ADD_GROUP(TYPE, NAME, ADDRESS) LOG_ADD(TYPE, NAME, ADDRESS)
#ifdef __arm__
#define LOG_PLACE(NAME) section(".log." #NAME), used
#else /* a section whose bounds the linker of a PC names by itself, without gaps */
#define LOG_PLACE(NAME) section("log_table"), used, aligned(sizeof(void *))
#endif
#define LOG_GROUP_START(NAME)                                                \
  static const struct log_s __logs_##NAME[] __attribute__((LOG_PLACE(NAME))) = { \
      LOG_ADD_GROUP(LOG_GROUP | LOG_START, NAME, 0x0)
#define LOG_GROUP_STOP(NAME) LOG_ADD_GROUP(LOG_GROUP | LOG_STOP, stop_##NAME, 0x0) };
