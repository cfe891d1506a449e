"""Where the robots of a swarm start."""

import pytest

from hil.config import load_config
from hil.servers.server import Server, Service


@pytest.mark.parametrize(("spacing", "sides"), [(0.0, (0.0, 0.0, 0.0, 0.0)), (0.5, (0.0, 0.5, -0.5, 1.0))])
def test_robots_of_one_room_start_side_by_side(spacing: float, sides: tuple[float, ...]) -> None:
    config = load_config("floaty", [f"flight.spacing={spacing}"])
    for number, side in enumerate(sides, 1):
        server = Server(Service(config, number), lambda line: None)
        assert server.robot.body.p_WB.tolist() == [0.0, side, 1.15]
