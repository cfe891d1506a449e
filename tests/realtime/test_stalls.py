"""A server whose machine stalls: time goes on from where it stood, and the robot that is flown from outside is not lost."""

import signal
import time

from support.serving import PATIENCE_S, serve, station


def test_a_robot_flown_from_outside_survives_a_stall_of_its_world() -> None:
    with serve("--udp", "0", motive=True) as lab:
        with station(lab, lab.udp_uris[0], "--duration", "12") as typed:
            lab.wait_for("released", PATIENCE_S)
            lab.process.send_signal(signal.SIGSTOP)
            time.sleep(1.0)
            lab.process.send_signal(signal.SIGCONT)
            lab.wait_for(r"time stood still for (9|1\d)\d\d ms", PATIENCE_S)
            assert typed.process.wait(PATIENCE_S) == 0, typed.lines
        assert lab.interrupt() == 0
        assert not any("lost" in line for line in lab.lines)
