"""Where several robots of one server start."""

import pytest

from hil.config import load_config
from hil.servers.server import Server, Service


@pytest.mark.parametrize(("spacing", "sides"), [(0.0, (0.0, 0.0, 0.0, 0.0)), (0.5, (0.0, 0.5, -0.5, 1.0))])
def test_robots_of_one_room_start_side_by_side(spacing: float, sides: tuple[float, ...]) -> None:
    server = Server(Service(load_config("floaty", [f"flight.spacing={spacing}"]), 4), lambda line: None)
    try:
        places = [served.robot.body.p_WB.tolist() for served in server.ends.robots]
        assert places == [[0.0, side, 1.15] for side in sides]
    finally:
        server.ends.close()
