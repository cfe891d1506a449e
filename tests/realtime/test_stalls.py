"""A server whose machine stalls: time goes on from where it stood, and the robot that is flown from outside is not lost."""

import signal
import subprocess
import sys
import time

from support.serving import serve


def test_a_robot_flown_from_outside_survives_a_stall_of_its_world() -> None:
    with serve("--udp", "0", motive=True) as lab:
        motive = lab.line("motive ")[0]
        command = [
            sys.executable,
            "-m",
            "hil.commands",
            "station",
            "--mocap",
            motive,
            "--link",
            lab.udp_uris[0],
        ]
        station = subprocess.Popen([*command, "--duration", "15"], stdout=subprocess.PIPE, text=True)
        try:
            lab.wait_for("released", 60.0)
            lab.process.send_signal(signal.SIGSTOP)
            time.sleep(1.0)
            lab.process.send_signal(signal.SIGCONT)
            lab.wait_for(r"time stood still for (9|1\d)\d\d ms", 10.0)
            said, _ = station.communicate(timeout=60)
        finally:
            station.kill()
        assert station.returncode == 0, said
        assert lab.interrupt() == 0
        assert not any("lost" in line for line in lab.lines)
