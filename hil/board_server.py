"""Boards for real clients: one thread that lets simulated time follow the wall clock and answers sockets in between.

Nothing blocks but the wait for the next instant or the next packet, whichever comes first. When the machine is too
slow simulated time stands still and goes on from there (`hil.clock.Paced`).
"""

import select
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

from hil.clock import Paced
from hil.config import LabConfig
from hil.dongle_server import DongleServer, Readers
from hil.errors import LabError
from hil.events import EventQueue
from hil.harness import Streams
from hil.markers import NO_POINTS, marker_places
from hil.serial_server import Address
from hil.served_board import ServedBoard
from hil.virtual_dongle import VirtualDongle
from hil.virtual_motive import Streaming, VirtualMotive

WARM_UP_US = 20_000  # run before anybody looks: the first run on a machine compiles
DONGLE_SEED = 10_000  # random streams of dongles: apart from those of the boards


class BoardServer:
    """`count` boards; open `serve_radio`, `serve_udp` or (on boards made with `mavlink`) `serve_mavlink`, then `run`."""

    def __init__(
        self, config: LabConfig, count: int, seed: int, say: Callable[[str], None], mavlink: bool = False
    ) -> None:
        self.events = EventQueue()
        self.readers: Readers = {}
        self.clock = Paced()
        self._say = say
        self.boards = [
            ServedBoard(number, config, self.events, Streams.of_seed(seed + number - 1), say, mavlink)
            for number in range(1, count + 1)
        ]
        self._config = config
        self._seed = seed + DONGLE_SEED
        self._dongles: DongleServer | None = None
        self.motive: VirtualMotive | None = None
        while self.events.now_us < WARM_UP_US:
            self._step()

    def serve_radio(self, port: int) -> str:
        """Offer Crazyradios on a port (0: any); returns the address for FLOATY_DONGLE."""
        self._dongles = DongleServer(port, self.readers, self._new_dongle)
        return self._dongles.address

    def serve_udp(self, port: int) -> list[str]:
        """Offer every board on UDP, from this port on; returns their URIs."""
        uris = []
        for board in self.boards:
            board.serve_udp(port + board.number - 1 if port else 0, self.readers)
            assert board.udp is not None
            uris.append(f"udp://127.0.0.1:{board.udp.port}")
        return uris

    def serve_mavlink(self, addresses: Sequence[Address]) -> list[str]:
        """Lead out the serial line of every board; returns what MAVProxy calls their ends."""
        try:
            return [
                board.serve_mavlink(address, self.readers)
                for board, address in zip(self.boards, addresses, strict=True)
            ]
        except LabError:
            self.close()
            raise

    def serve_motive(self, settings: Streaming) -> VirtualMotive:
        """Let Motive see every board, under its number."""
        names = {
            board.number: "floaty" if board.number == 1 else f"floaty{board.number}" for board in self.boards
        }
        config = self._config
        markers = marker_places(config.plant) if config.markers.enabled else NO_POINTS
        self.motive = VirtualMotive(settings, names, self.readers, markers)
        for board in self.boards:
            board.show(partial(self.motive.take, board.number))
        return self.motive

    def run(self, stopping: Callable[[], bool]) -> None:
        """Go on until told to stop; may be called again."""
        events, readers, clock = self.events, self.readers, self.clock
        clock.start(events.now_us)
        while not stopping():
            next_us = events.next_us or 0
            ready, _, _ = select.select(readers, (), (), clock.ahead_us(next_us) * 1e-6)
            if ready:
                now_us = max(events.now_us, min(clock.now_us(), next_us))
                for reader in ready:
                    with suppress(KeyError):  # closed by one of the others
                        readers[reader](now_us)
            if clock.now_us() >= (events.next_us or 0):
                self._step()
            for line in clock.notices():
                self._say(line)

    def _step(self) -> None:
        """Do everything that hardware does at the next instant."""
        assert self.events.next_us is not None  # the IMUs never rest
        self.events.run(self.events.next_us)

    def close(self) -> None:
        """Close all sockets."""
        for board in self.boards:
            board.close()
        if self._dongles is not None:
            self._dongles.close()
        if self.motive is not None:
            self.motive.close()

    def _new_dongle(self) -> VirtualDongle:
        self._seed += 1
        rng = Streams.of_seed(self._seed).radio
        return VirtualDongle(self._config.radio, self.events, rng, [board.nrf51 for board in self.boards])
