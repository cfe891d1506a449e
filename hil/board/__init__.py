"""The hardware around the board: pins, links, sensors, cameras; and the boards themselves, with one interface."""
