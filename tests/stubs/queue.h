#pragma once
#include "FreeRTOS.h"
struct QueueDefinition;
typedef struct QueueDefinition *QueueHandle_t;
#define queueSEND_TO_BACK ((BaseType_t)0)
QueueHandle_t xQueueGenericCreateStatic(const UBaseType_t length, const UBaseType_t item_size, uint8_t *storage,
                                        StaticQueue_t *queue, const uint8_t type);
BaseType_t xQueueGenericSend(QueueHandle_t queue, const void *const item, TickType_t ticks, const BaseType_t position);
BaseType_t xQueueReceive(QueueHandle_t queue, void *const item, TickType_t ticks);
#define xQueueCreateStatic(length, size, storage, queue) \
  xQueueGenericCreateStatic((length), (size), (storage), (queue), (uint8_t)0)
#define xQueueSend(queue, item, ticks) xQueueGenericSend((queue), (item), (ticks), queueSEND_TO_BACK)
