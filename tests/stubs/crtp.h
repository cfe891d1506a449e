#pragma once
#include <stdbool.h>
#include <stdint.h>
#define CRTP_MAX_DATA_SIZE 30
typedef enum { CRTP_PORT_LOCALIZATION = 0x06, CRTP_PORT_SETPOINT_HL = 0x08 } CRTPPort;
typedef struct {
  uint8_t size; /* of data */
  union {
    uint8_t header;
    struct {
      uint8_t channel : 2;
      uint8_t reserved : 2;
      uint8_t port : 4;
    };
  };
  uint8_t data[CRTP_MAX_DATA_SIZE];
} __attribute__((packed)) CRTPPacket;
typedef void (*CrtpCallback)(CRTPPacket *);
void crtpRegisterPortCB(int, CrtpCallback);
int crtpSendPacket(CRTPPacket *);
int crtpReceivePacket(CRTPPort, CRTPPacket *);
bool crtpIsConnected(void);
