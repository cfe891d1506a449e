#pragma once
#include "FreeRTOS.h"
struct QueueDefinition;
typedef struct QueueDefinition *QueueHandle_t;
#define queueSEND_TO_BACK ((BaseType_t)0)
QueueHandle_t xQueueGenericCreateStatic(UBaseType_t, UBaseType_t, uint8_t *, StaticQueue_t *, uint8_t);
BaseType_t xQueueGenericSend(QueueHandle_t, const void *, TickType_t, BaseType_t);
BaseType_t xQueueGenericReset(QueueHandle_t, BaseType_t);
#define xQueueReset(QUEUE) xQueueGenericReset((QUEUE), pdFALSE)
BaseType_t xQueueReceive(QueueHandle_t, void *, TickType_t);
#define xQueueCreateStatic(LENGTH, SIZE, STORAGE, QUEUE) \
  xQueueGenericCreateStatic((LENGTH), (SIZE), (STORAGE), (QUEUE), (uint8_t)0)
#define xQueueSend(QUEUE, ITEM, TICKS) xQueueGenericSend((QUEUE), (ITEM), (TICKS), queueSEND_TO_BACK)
