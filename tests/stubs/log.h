/* Log variables lie between marks in a section of their own, in tables that begin and end with a group entry. */
#pragma once
#include <stdbool.h>
#include <stdint.h>
typedef uint16_t logVarId_t;
logVarId_t logGetVarId(const char *group, const char *name);
int logGetInt(logVarId_t varid);
#define LOG_VARID_IS_VALID(varId) (varId != 0xffffu)
struct log_s {
  uint8_t type;
  char *name;
  void *address;
};
#define LOG_UINT8 1
#define LOG_UINT16 2
#define LOG_UINT32 3
#define LOG_INT16 5
#define LOG_FLOAT 7
#define LOG_GROUP 0x80
#define LOG_START 1
#define LOG_STOP 0
#define LOG_ADD(TYPE, NAME, ADDRESS) {.type = TYPE, .name = #NAME, .address = (void *)(ADDRESS)},
#define LOG_ADD_GROUP(TYPE, NAME, ADDRESS) LOG_ADD(TYPE, NAME, ADDRESS)
#define LOG_GROUP_START(NAME)                                                                   \
  static const struct log_s __logs_##NAME[] __attribute__((section(LOG_SECTION(NAME)), used, aligned(sizeof(void *)))) = { \
      LOG_ADD_GROUP(LOG_GROUP | LOG_START, NAME, 0x0)
#define LOG_GROUP_STOP(NAME) LOG_ADD_GROUP(LOG_GROUP | LOG_STOP, stop_##NAME, 0x0) };
#ifdef __arm__
#define LOG_SECTION(NAME) ".log." #NAME
#else /* a section whose bounds the linker of a PC names by itself */
#define LOG_SECTION(NAME) "log_table"
#endif
