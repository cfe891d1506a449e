"""The hardware around the board: pins, links, sensors, cameras."""
