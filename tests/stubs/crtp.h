#pragma once
#include <stdbool.h>
#include <stdint.h>
#define CRTP_MAX_DATA_SIZE 30
typedef enum { CRTP_PORT_LOCALIZATION = 0x06 } CRTPPort;
typedef struct _CRTPPacket {
  uint8_t size; /* of data */
  union {
    struct {
      union {
        uint8_t header;
        struct {
          uint8_t channel : 2;
          uint8_t reserved : 2;
          uint8_t port : 4;
        };
      };
      uint8_t data[CRTP_MAX_DATA_SIZE];
    };
    uint8_t raw[CRTP_MAX_DATA_SIZE + 1];
  };
} __attribute__((packed)) CRTPPacket;
typedef void (*CrtpCallback)(CRTPPacket *);
void crtpRegisterPortCB(int port, CrtpCallback cb);
