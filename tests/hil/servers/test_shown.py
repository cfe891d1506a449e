"""What a server shows of its first robot."""

from hil.config import load_config
from hil.laboratory.recorder import stored_in
from hil.scene import Look
from hil.servers.server import Server, Service
from support.watching import Watcher


def test_rows_of_a_served_robot_say_what_it_looks_like() -> None:
    watcher = Watcher()
    server = Server(Service(load_config()), lambda text: None, watcher)
    server.lab.end_at(1_000_000)
    server.lab.run()
    server.close()
    look = Look.read(stored_in(watcher.batches[0].schema.metadata, "look"))
    own = server.robot.body.look
    assert [part.name for part in look.parts] == [part.name for part in own.parts]
    assert len(look.outline) == len(own.outline) > 0
