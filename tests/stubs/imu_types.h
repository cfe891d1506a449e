#pragma once
typedef union {
  struct {
    float x, y, z;
  };
  float axis[3];
} Axis3f;
