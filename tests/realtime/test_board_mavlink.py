"""`floaty serve --mavlink` and a bare pymavlink program: what ground tools rely on, over pty, udp and tcp."""

import math
import os
import threading
from pathlib import Path

import pymavlink.dialects.v20.common as dialect
import pytest
from cflib.utils.power_switch import PowerSwitch

from ground_station.config import CaptureConfig
from ground_station.mocap import MocapSource
from ground_station.sources.address import find_source
from support.mavlink_socket import GAIN, MavlinkSocket
from support.plugged_dongle import plug
from support.serving import PATIENCE_S, Served, free_port, serve


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


def test_two_tcp_clients_hear_the_board_and_each_gets_its_answers() -> None:
    with serve("--mavlink", "tcp:0") as served:
        first, second = (MavlinkSocket(masters(served)[0]) for _ in range(2))
        for client in (first, second):
            assert client.command(dialect.MAV_CMD_NAV_LAND) == dialect.MAV_RESULT_UNSUPPORTED
        for client in (first, second):
            client.wait("HEARTBEAT")
            client.close()


def test_the_baud_rate_limits_what_comes_through() -> None:
    with serve("--mavlink", "tcp:0", "--set", "serial.baud=9600") as served:
        client = MavlinkSocket(masters(served)[0])
        client.wait("HEARTBEAT")
        for message in (dialect.MAVLINK_MSG_ID_ATTITUDE, dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED):
            client.codec.command_long_send(
                1, 1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message, 10_000, *[math.nan] * 5
            )
        client.collect(4.0)  # until what waits in the full buffer came
        arrived = client.collect(2.0)
        client.close()
    stamped = [number for number, message in enumerate(arrived) if message.get_type() == "ATTITUDE"]
    between = arrived[stamped[0] : stamped[-1]]
    bytes_received = sum(len(message.get_msgbuf()) for message in between)
    simulated_s = (arrived[stamped[-1]].time_boot_ms - arrived[stamped[0]].time_boot_ms) / 1000
    assert bytes_received / simulated_s == pytest.approx(960, rel=0.1)


def test_wrong_bits_spoil_frames_and_nothing_else() -> None:
    with serve("--mavlink", "tcp:0", "--set", "serial.downlink_bit_error_rate=1e-3") as served:
        client = MavlinkSocket(masters(served)[0])
        client.wait("HEARTBEAT")
        client.codec.command_long_send(
            1,
            1,
            dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
            0,
            dialect.MAVLINK_MSG_ID_ATTITUDE,
            10_000,
            *[math.nan] * 5,
        )
        arrived = [message for message in client.collect(3.0) if message.get_type() == "ATTITUDE"]
        assert client.codec.total_receive_errors > 0
        client.close()
    assert len(arrived) > 100


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


class Pilot:
    """Sends a served board's true poses as ATT_POS_MOCAP, every fourth of 200 per second, until stopped."""

    def __init__(self, client: MavlinkSocket, poses: MocapSource) -> None:
        self._client, self._poses = client, poses
        self._stopping = False
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "Pilot":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping = True
        self._thread.join()

    def _run(self) -> None:
        count = 0
        while not self._stopping:
            frame = self._poses.receive(0.1)
            count += 1
            if frame is None or count % 4:
                continue
            (w, x, y, z), (px, py, pz) = frame.q_WB, frame.p_WB
            self._client.codec.att_pos_mocap_send(frame.t_us, [w, x, -y, -z], px, -py, -pz)


def test_poses_fly_the_board_and_a_pulled_pty_ends_in_failsafe_until_it_is_plugged_in_again() -> None:
    with serve("--mavlink", "pty", motive=True) as served:
        poses = find_source(served.motive, CaptureConfig())
        poses.open()
        client = MavlinkSocket(masters(served)[0])
        with Pilot(client, poses):
            served.wait_for("board 1: released", PATIENCE_S)
            with pytest.raises(AssertionError, match="no line"):  # it flies free
                served.wait_for("lost|failsafe", 2.0)
        client.close()  # the cable is pulled
        served.wait_for("supervisor: failsafe, silence", PATIENCE_S)
        served.wait_for("it is put back", PATIENCE_S)
        served.forget()
        client = MavlinkSocket(masters(served)[0])
        with Pilot(client, poses):
            served.wait_for("supervisor: flying", PATIENCE_S)
            served.wait_for("board 1: released", PATIENCE_S)
        client.close()
        poses.close()


def test_a_reboot_by_radio_keeps_the_end_and_forgets_what_came_while_the_board_was_off() -> None:
    with serve("--mavlink", "tcp:0", "--radio", "--radio-port", "0") as served:
        plug(served)
        client = MavlinkSocket(masters(served)[0])
        before_ms = client.wait("ATTITUDE", lambda message: message.time_boot_ms > 1000).time_boot_ms
        switch = PowerSwitch(served.radio_uris[0])
        switch.stm_power_down()
        client.codec.param_set_send(1, 1, GAIN.encode(), 2.5, dialect.MAV_PARAM_TYPE_REAL32)
        client.collect(0.1)  # it has passed the line
        switch.stm_power_up()
        switch.close()
        client.wait("ATTITUDE", lambda message: message.time_boot_ms < before_ms)
        assert client.parameters()[GAIN].param_value == 3.0
        client.close()
