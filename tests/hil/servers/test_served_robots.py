"""What a server shows of its first robot, and where several start."""

import pytest

from hil.config import load_config
from hil.laboratory.recorder import stored_in
from hil.scene import Look
from hil.servers.server import Server, Service
from support.watching import Watcher


def test_rows_of_a_served_robot_describe_its_look() -> None:
    watcher = Watcher()
    server = Server(Service(load_config()), lambda text: None, watcher)
    server.lab.end_at(1_000_000)
    server.lab.run()
    server.close()
    look = Look.read(stored_in(watcher.batches[0].schema.metadata, "look"))
    own = server.robot.body.look
    assert [part.name for part in look.parts] == [part.name for part in own.parts]
    assert len(look.outline) == len(own.outline) > 0


# Where several robots of one server start


@pytest.mark.parametrize(("spacing", "sides"), [(0.0, (0.0, 0.0, 0.0, 0.0)), (0.5, (0.0, 0.5, -0.5, 1.0))])
def test_robots_of_one_room_start_side_by_side(spacing: float, sides: tuple[float, ...]) -> None:
    config = load_config("floaty", [f"flight.spacing={spacing}"])
    for number, side in enumerate(sides, 1):
        server = Server(Service(config, number), lambda line: None)
        assert server.robot.body.p_WB.tolist() == [0.0, side, 1.15]
