// Finds a Crazyradio by libusb, tunes it, and pings the board of an address; with a height [m] it has the board take off.
#include <libusb-1.0/libusb.h>
#include <cstdio>
#include <cstdlib>
#include <cstring>
int main(int argc, char **argv) {
  libusb_context *context;
  if (libusb_init(&context)) return 2;
  libusb_device_handle *radio = libusb_open_device_with_vid_pid(context, 0x1915, 0x7777);
  if (!radio) { std::puts("no radio"); return 3; }
  unsigned char name[64];
  libusb_device_descriptor descriptor;
  libusb_get_device_descriptor(libusb_get_device(radio), &descriptor);
  libusb_get_string_descriptor_ascii(radio, descriptor.iSerialNumber, name, sizeof name);
  std::printf("serial %s\n", name);
  if (libusb_claim_interface(radio, 0)) return 4;
  unsigned char address[5] = {0xE7, 0xE7, 0xE7, 0xE7, (unsigned char)std::strtol(argv[1], 0, 16)};
  libusb_control_transfer(radio, 0x40, 0x01, 80, 0, nullptr, 0, 1000);
  libusb_control_transfer(radio, 0x40, 0x03, 2, 0, nullptr, 0, 1000);
  if (libusb_control_transfer(radio, 0x40, 0x02, 0, 0, address, 5, 1000) != 5) return 5;
  int answered = 0;
  for (int i = 0; i < 200; i++) {
    unsigned char null_packet = 0xFF, answer[64];
    int sent, size;
    if (libusb_bulk_transfer(radio, 0x01, &null_packet, 1, &sent, 1000)) return 6;
    if (libusb_bulk_transfer(radio, 0x81, answer, sizeof answer, &size, 1000)) return 7;
    answered += answer[0] & 1;
  }
  if (argc > 2) {
    float height = std::strtof(argv[2], 0), duration = 1.0f;
    unsigned char take_off[16] = {0x80, 7};  // high-level commander: group, height, yaw, keep the yaw, duration
    std::memcpy(take_off + 3, &height, 4);
    take_off[11] = 1;
    std::memcpy(take_off + 12, &duration, 4);
    unsigned char answer[64] = {0};
    for (int sent, size; !(answer[0] & 1);) {
      if (libusb_bulk_transfer(radio, 0x01, take_off, sizeof take_off, &sent, 1000)) return 8;
      if (libusb_bulk_transfer(radio, 0x81, answer, sizeof answer, &size, 1000)) return 9;
    }
  }
  unsigned char answer[64];
  int size;
  int nothing = libusb_bulk_transfer(radio, 0x81, answer, sizeof answer, &size, 50);
  std::printf("%d answers; then %s\n", answered, libusb_error_name(nothing));
  libusb_release_interface(radio, 0);
  libusb_close(radio);
  libusb_exit(context);
  return 0;
}
