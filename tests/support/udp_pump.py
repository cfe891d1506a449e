"""A board on a udp port with nothing around it: still IMU, flaps in the air, time as on the wall."""

import select
import socket
import threading
import time

from support.crtp_client import CrtpClient

STEP_S = 0.001


class UdpBoard(CrtpClient):
    """Runs in a thread of its own from creation to `close`; the newest client has the board."""

    def __init__(self) -> None:
        self.peer: tuple[str, int] | None = None
        self._left: set[tuple[str, int] | None] = set()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        super().__init__()
        self.imu = (3, -2, 1, 0, 0, 1365)  # 1 g
        self.run(700_000)  # compiled, gyro zero found
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.uri = f"udp://127.0.0.1:{self.port}"
        self._stopping = False
        self._thread = threading.Thread(target=self._loop)
        self._thread.start()

    def radio_send(self, data: bytes) -> bool:
        if self.peer is None:
            return False
        self.socket.sendto(data, self.peer)
        return True

    def power_off(self) -> None:
        """Stop and close the port, so that clients are refused."""
        self.close()
        self.peer = None

    def power_on(self) -> None:
        """Boot with the memories of before, on the same port."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.reboot()
        self.run(700_000)
        self.socket.bind(("127.0.0.1", self.port))
        self._stopping = False
        self._thread = threading.Thread(target=self._loop)
        self._thread.start()

    def close(self) -> None:
        self._stopping = True
        self._thread.join()
        self.socket.close()

    def _loop(self) -> None:
        start_s = time.monotonic() - self.now_us * 1e-6
        while not self._stopping:
            ready, _, _ = select.select((self.socket,), (), (), STEP_S)
            self.run(max(self.now_us, int((time.monotonic() - start_s) * 1e6)))
            if ready:
                self._take(*self.socket.recvfrom(64))

    def _take(self, data: bytes, sender: tuple[str, int]) -> None:
        """Pass a datagram on; the newest client has the board, and what older ones still say is not heard."""
        if sender in self._left:
            return
        if self.peer not in (None, sender):
            self._left.add(self.peer)
        self.peer = sender
        self.firmware.radio_received(data)
