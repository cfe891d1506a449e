"""`floaty serve --mavlink` and a bare pymavlink program: what ground tools rely on, over pty, udp and tcp."""

import math
import os
import time
from pathlib import Path

import pymavlink.dialects.v20.development as dialect
import pytest
from cflib.utils.power_switch import PowerSwitch

from support.mavlink_socket import GAIN, MavlinkSocket
from support.plugged_dongle import plug
from support.serving import Served, free_port, serve


def masters(served: Served) -> list[str]:
    return served.line("mavlink ")


@pytest.mark.parametrize("end", ["pty", "udp", "tcp"])
def test_every_end_carries_the_whole_parameter_table(end: str) -> None:
    with serve("--mavlink", f"udp:{free_port()}" if end == "udp" else end + ":0" * (end == "tcp")) as served:
        client = MavlinkSocket(masters(served)[0])
        client.wait("HEARTBEAT")  # then the board's port is known
        found = client.parameters()
        client.close()
    assert len(found) > 30
    assert {message.param_index for message in found.values()} == set(range(len(found)))
    assert {message.param_count for message in found.values()} == {len(found)}
    assert {message.param_type for message in found.values()} == {dialect.MAV_PARAM_TYPE_REAL32}
    assert all(math.isfinite(message.param_value) for message in found.values())


def test_several_boards_have_ends_and_system_ids_of_their_own(tmp_path: Path) -> None:
    with serve("--mavlink", f"pty:{tmp_path / 'line'}", "--boards", "2") as served:
        assert not any(line.startswith("udp") for line in served.lines)
        assert masters(served) == [str(tmp_path / "line"), str(tmp_path / "line-2")]
        for number, master in enumerate(masters(served), 1):
            client = MavlinkSocket(master)
            assert client.wait("HEARTBEAT").get_srcSystem() == number
            client.close()
        assert served.interrupt() == 0
    assert os.listdir(tmp_path) == []


def test_a_reboot_by_radio_keeps_the_end_and_forgets_what_came_while_the_board_was_off() -> None:
    with serve("--mavlink", "tcp:0", "--radio", "--radio-port", "0") as served:
        plug(served)
        client = MavlinkSocket(masters(served)[0])
        before_ms = client.wait("ATTITUDE", lambda message: message.time_boot_ms > 1000).time_boot_ms
        switch = PowerSwitch(served.radio_uris[0])
        switch.stm_power_down()
        client.codec.param_set_send(1, 1, GAIN.encode(), 2.5, dialect.MAV_PARAM_TYPE_REAL32)
        time.sleep(0.1)  # it has passed the line
        switch.stm_power_up()
        switch.close()
        client.wait("ATTITUDE", lambda message: message.time_boot_ms < before_ms)
        assert client.parameters()[GAIN].param_value == 3.0
        client.close()
