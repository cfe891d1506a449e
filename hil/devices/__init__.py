"""The hardware around the board: its pins, the radio and serial links, the cameras."""
