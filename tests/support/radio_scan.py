"""A program that moves a board's radio from channel to channel and measures each, until Ctrl-C, with cflib's dongle.

`radio_scan.py` prints each channel on which it has heard the board. It does what cflib's example `radio_test.py` does.
"""

from itertools import cycle

from cflib.drivers.crazyradio import Crazyradio

MOVE, NULL = (0xFF, 0x03, 0x01), (0xFF,)
HOME = 80
TRIES = 20


def main() -> None:
    radio = Crazyradio()
    radio.set_channel(HOME)
    radio.set_data_rate(Crazyradio.DR_2MPS)
    radio.set_arc(0)
    for channel in cycle(range(126)):
        for _ in range(TRIES):
            radio.send_packet((*MOVE, channel))
        radio.set_channel(channel)
        if any(radio.send_packet(NULL).ack for _ in range(TRIES)):
            print(channel, flush=True)


main()
