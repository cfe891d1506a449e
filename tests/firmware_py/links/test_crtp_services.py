"""What `tests/conformance/test_services.py` does not ask: tables, times, stores, bounds and counters of the CRTP services.

cflib's own classes read the tables and memories.
"""

import ctypes
import errno
import json
import struct
from math import inf, nan
from types import SimpleNamespace

import numpy as np
import pytest
from cflib.crazyflie.log import LogTocElement
from cflib.crazyflie.mem.i2c_element import I2CElement
from cflib.crazyflie.param import ParamTocElement
from cflib.utils.encoding import compress_quaternion
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_py.config import parameters_of
from firmware_py.links.console import Notices, pieces
from firmware_py.links.crtp_stack import PORT_QUEUE
from firmware_py.links.parameters import ParameterStorage
from firmware_py.wire import crtp, telemetry
from firmware_py.wire.localisation import encode_packed_poses, pack_quaternion, unpack_quaternion
from firmware_py.wire.memories import CONFIG_SIZE, RadioSettings, encode_config
from firmware_py.wire.parameters import TYPE_READ_ONLY
from firmware_py.wire.scalars import LOG_SCALARS, PARAMETER_SCALARS, Scalar
from firmware_py.wire.toc import Toc
from hil.config import load_config
from support.crtp_client import LOC, LOG, MEM, PARAM, PLATFORM, CrtpClient
from support.firmware_bench import HOVER_COUNTS
from support.paths import VECTORS

C_TYPES = {
    Scalar.U8: ctypes.c_uint8, Scalar.U16: ctypes.c_uint16, Scalar.U32: ctypes.c_uint32,
    Scalar.I8: ctypes.c_int8, Scalar.I16: ctypes.c_int16, Scalar.I32: ctypes.c_int32,
}  # fmt: skip


@pytest.fixture
def client() -> CrtpClient:
    return CrtpClient()


@pytest.fixture(scope="module")
def params() -> dict[str, tuple[int, int]]:
    return CrtpClient().toc(PARAM)


@pytest.fixture(scope="module")
def logs() -> dict[str, tuple[int, int]]:
    return CrtpClient().toc(LOG)


# Platform and what is counted


def test_the_board_is_named_and_a_program_s_notice_comes_back_whole(client: CrtpClient) -> None:
    assert client.one(PLATFORM, 1, b"\2") == b"\2C21F\0"
    assert client.one(PLATFORM, 0, b"\3\1") == b"\3\1"


@pytest.mark.long
@pytest.mark.parametrize(
    ("port", "channel", "data", "malformed", "unserved"),
    [
        (LOC, crtp.CHANNEL_GENERIC, b"\xee", 1, 0),
        (LOC, crtp.CHANNEL_GENERIC, struct.pack("<B7f", crtp.EXT_POSE, *7 * [nan]), 1, 0),
        (LOC, 3, b"\0", 0, 1),
        (LOC, 0, struct.pack("<3f", 0, 0, 0), 0, 0),  # a place without attitude
        (LOC, 2, struct.pack("<Bhhh", 0xE7, 0, 0, 0), 0, 0),
        (PLATFORM, 2, b"no pose", 1, 0),
    ],
)
def test_what_is_no_pose_is_counted_and_not_flown(
    client: CrtpClient, port: int, channel: int, data: bytes, malformed: int, unserved: int
) -> None:
    client.run(610_000)
    assert client.ask(port, channel, data, 90_000) == []
    assert (client.firmware.link.malformed, client.firmware.link.unserved) == (malformed, unserved)
    assert client.firmware.signals.supervisor.state.name == "WAITING"


# Tables of contents


@pytest.mark.parametrize(
    ("port", "element", "read_only"),
    [(LOG, LogTocElement, ()), (PARAM, ParamTocElement, ("cpu.flash", "firmware.revision0"))],
)
def test_cflib_reads_every_entry_of_the_table(
    client: CrtpClient, port: int, element: type, read_only: tuple[str, ...]
) -> None:
    count = struct.unpack_from("<H", client.one(port, 0, b"\3"), 1)[0]
    table = [client.one(port, 0, struct.pack("<BH", 2, number))[3:] for number in range(count)]
    listed = [element(number, data) for number, data in enumerate(table)]
    assert all(len(entry.group) + len(entry.name) <= 24 for entry in listed)
    entries = {f"{entry.group}.{entry.name}": entry for entry in listed}
    assert len(entries) == count > 60
    assert client.one(port, 0, struct.pack("<BH", 2, count)) == b"\2"
    for name in read_only:
        assert entries[name].access == ParamTocElement.RO_ACCESS
        assert (
            entries["extCtrl.x_P"].access == entries["motorPowerSet.m1"].access == ParamTocElement.RW_ACCESS
        )


def test_the_two_tables_have_different_checksums(client: CrtpClient) -> None:
    log, param = (struct.unpack_from("<I", client.one(port, 0, b"\3"), 3)[0] for port in (LOG, PARAM))
    assert log != param
    assert Toc.of(LOG, [(1, "a.b")]).crc != Toc.of(PARAM, [(1, "a.b")]).crc  # even of equal tables


def test_floatys_own_names_are_there_beside_those_of_the_stock_firmware(logs, params) -> None:
    own = "controller.m1 motors_ctrp.m1 locSrv.age Error.int_z_err acc.z stateEstimate.roll_rate stateEstimate.flap_1"
    assert set(own.split()) <= logs.keys()
    own = "extCtrl.manual extCtrl.target_yaw extCtrl.x_P extCtrl.yaw_rate_P extCtrl.m1 delayComp.activate setpoint.X "
    own += "motorShifts.m1 motorPowerSet.enable kalman.maxPos RandConsts.flapHoverAng FloatyKalm.resetKalman "
    own += "firmware.revision0 imu_sensors.BMP3XX"
    assert set(own.split()) <= params.keys()


def test_attitudes_are_shown_in_degrees_with_the_nose_up_positive_as_the_stock_firmware_shows_them(
    client: CrtpClient,
) -> None:
    # The nose is down.
    qx, qy, qz, qw = Rotation.from_euler("ZYX", (15, 10, 5), degrees=True).as_quat().tolist()
    data = crtp.encode_ext_pose((0.0, 0.0, 0.0), (qw, qx, qy, qz), 40_000)
    client.events.at(605_000, lambda now_us: client.firmware.radio_received(data))
    client.run(650_000)
    shown = {variable.name: variable.read() for variable in client.firmware.variables}
    quaternion = [shown[f"stateEstimate.{name}"] for name in ("qx", "qy", "qz", "qw")]
    yaw, pitch, roll = Rotation.from_quat(quaternion).as_euler("ZYX", degrees=True)
    assert min(yaw, pitch, roll) > 4
    for group in ("stateEstimate", "stabilizer"):
        angles = [shown[f"{group}.{name}"] for name in ("roll", "pitch", "yaw")]
        assert angles == pytest.approx([roll, -pitch, yaw], rel=1e-5)


@pytest.mark.parametrize(
    ("mv", "level"), [(2999, 0), (3000, 0), (3001, 10), (3780, 10), (3781, 20), (4100, 90), (4101, 90)]
)
def test_a_battery_is_shown_by_the_stock_firmwares_curve_and_is_low_below_its_limit(
    client: CrtpClient, logs, mv: int, level: int
) -> None:
    client.battery_mv = mv
    client.firmware._core.parameters.fields.low_battery_mv = 3000
    assert client.log(logs, "pm.batteryLevel", "pm.state", "pm.vbatMV") == [level, 3 * (mv < 3000), mv]


@pytest.mark.long
def test_telemetry_tells_the_excitation_sample_by_sample(client: CrtpClient, params) -> None:
    client.poses(605_000, 3_000_000)
    client.write(params, "excite.u1", 0.05)
    client.stream(client.now_us)
    client.run(1_000_000)
    for signal in (0, 1, 0):
        client.write(params, "excite.signal", signal)
        client.run(client.now_us + 50_000)
        client.samples.clear()
        client.run(client.now_us + 500_000)
        rows = [sample.values for sample in client.samples if sample.block is telemetry.CONTROL]
        assert len(rows) == 25
        excitation = {row[8] for row in rows}
        assert len(excitation) > 20 if signal else excitation == {0.0}
        assert {row[9:] for row in rows} == {(0.0, 0.0, 0.0)}


@pytest.mark.long
@pytest.mark.parametrize("kind", ["a block", "telemetry"])
def test_rows_end_a_second_after_silence_and_the_next_gets_none(client: CrtpClient, logs, kind: str) -> None:
    if kind == "telemetry":
        client.stream(client.now_us)
    else:
        for number in (1, 2):  # the second one is stopped
            assert client.create(number, logs["pm.vbatMV"][::-1]) == 0
            assert client.one(LOG, 1, bytes((3, number, 1))) == bytes((3, number, 0))
        assert client.one(LOG, 1, bytes((4, 2))) == bytes((4, 2, 0))
    client.run(client.now_us + 3_000_000)  # the radio chip is polled, that is enough
    client.sent.clear()
    client.polling = False
    silent_us = client.now_us
    client.run(silent_us + 500_000)
    client.radio_open = False  # nobody fetches the chip's packets any more
    client.run(silent_us + 3_000_000)
    client.radio_open = client.polling = True
    client.run(client.now_us + 500_000)
    rows = client.packets(LOG, 2)
    last_ms = max(int.from_bytes(row[1:4], "little") for row in rows)
    assert last_ms <= silent_us // 1000 + 510  # one was already on its way to the chip
    for number in (1, 2):
        assert client.one(LOG, 1, bytes((3, number, 1))) == bytes((3, number, errno.ENOENT))
    client.stream(client.now_us)
    client.run(client.now_us + 100_000)
    assert client.packets(LOG, 2)


@pytest.mark.parametrize("broadcast", [False, True])
def test_without_polls_a_packet_per_second_keeps_rows_coming(
    client: CrtpClient, logs, broadcast: bool
) -> None:
    assert client.create(1, logs["pm.vbatMV"][::-1]) == 0
    assert client.one(LOG, 1, bytes((3, 1, 1))) == bytes((3, 1, 0))
    client.polling = False
    for _ in range(3):
        client.run(client.now_us + 990_000)
        client.firmware.radio_received(b"\xff\0", broadcast)
    client.sent.clear()
    client.run(client.now_us + 2_000_000)
    assert 99 <= len(client.packets(LOG, 2)) <= 101


def test_the_load_that_is_logged_is_what_the_tasks_took_of_each_period(client: CrtpClient, logs) -> None:
    assert client.create(7, logs["system.load"][::-1]) == 0
    assert client.one(LOG, 1, bytes((3, 7, 50))) == bytes((3, 7, 0))
    kernel, told, true = client.firmware.kernel, [], []

    def busy_us() -> int:
        return sum(kernel.run_time_us(task) for task in kernel.tasks if task.name != "IDLE")

    client.run(-client.now_us % 500_000 + client.now_us)
    for _ in range(4):
        before_us = busy_us()
        client.sent.clear()
        client.run(client.now_us + 500_000)
        true.append(100 * (busy_us() - before_us) / 500_000)
        (row,) = client.packets(LOG, 2)
        told.append(struct.unpack_from("<f", row, 4)[0])
    assert told[1:] == pytest.approx(true[1:], rel=0.03)
    assert 1.0 < min(told) <= max(told) < 50.0


def test_newer_start_counts_in_milliseconds_a_stop_ends_it_and_period_zero_sends_once(
    client: CrtpClient, logs
) -> None:
    assert client.create(1, logs["pm.vbatMV"][::-1]) == 0
    assert client.one(LOG, 1, struct.pack("<BBH", 8, 1, 4)) == bytes((8, 1, 0))
    client.sent.clear()
    client.run(client.now_us + 100_000)
    assert len(client.packets(LOG, 2)) == 25
    assert client.one(LOG, 1, bytes((4, 1))) == bytes((4, 1, 0)), "stopped"
    client.sent.clear()
    client.run(client.now_us + 100_000)
    assert client.packets(LOG, 2) == []
    assert client.one(LOG, 1, struct.pack("<BBH", 8, 1, 0)) == bytes((8, 1, 0))
    client.sent.clear()
    client.run(client.now_us + 100_000)
    assert len(client.packets(LOG, 2)) <= 1


def test_a_period_in_milliseconds_has_two_bytes_and_one_in_tens_has_one(client: CrtpClient, logs) -> None:
    assert client.create(1, logs["pm.vbatMV"][::-1]) == 0
    malformed = client.firmware.link.malformed
    for start, count in ((struct.pack("<BBH", 8, 1, 0x0104), 1), (struct.pack("<BBH", 3, 1, 0x010D), 3)):
        assert client.one(LOG, 1, start) == start[:2] + b"\0"
        client.sent.clear()
        client.run(client.now_us + 400_000)
        assert len(client.packets(LOG, 2)) == count
    for start in (bytes((8, 1)), bytes((8, 1, 4)), bytes((3, 1))):
        assert client.ask(LOG, 1, start) == []
    assert client.firmware.link.malformed == malformed + 3


def test_at_most_128_variables_are_in_blocks(client: CrtpClient, logs) -> None:
    number = logs["supervisor.state"][0]
    assert client.create(16, (1, len(logs) - 1)) == 0
    assert client.create(17, (1, len(logs))) == errno.ENOENT
    assert client.one(LOG, 1, b"\5\0") == b"\5\0\0"
    for block in range(16):
        assert client.create(block, *[(1, number)] * 8) == 0
    assert client.one(LOG, 1, bytes((7, 3)) + struct.pack("<BH", 1, number)) == bytes((7, 3, errno.ENOMEM))


def test_a_block_has_room_for_26_bytes_of_values(client: CrtpClient, logs) -> None:
    number = logs["supervisor.state"][0]
    assert client.create(1, *[(3, number)] * 6, (2, number)) == 0
    assert client.one(LOG, 1, bytes((7, 1)) + struct.pack("<BH", 1, number)) == bytes((7, 1, errno.E2BIG))


def test_a_full_request_of_cflibs_ends_in_the_middle_of_an_item(client: CrtpClient, logs) -> None:
    number, kind = logs["stateEstimate.x"]
    data = bytes((6, 1)) + struct.pack("<BH", 1, logs["supervisor.state"][0]) * 9 + bytes((kind,))
    assert len(data) == 30
    assert client.one(LOG, 1, data) == bytes((6, 1, 0))
    assert client.one(LOG, 1, bytes((7, 1)) + struct.pack("<BH", kind, number)) == bytes((7, 1, 0))


def test_a_block_that_the_processor_kept_waiting_returns_to_its_grid(client: CrtpClient, logs) -> None:
    taken_us = 0
    client.firmware.kernel.occupy("LOAD", lambda: taken_us)
    assert client.create(1, logs["pm.vbatMV"][::-1]) == 0
    client.one(LOG, 1, bytes((3, 1, 2)))
    client.sent.clear()
    client.run(client.now_us + 200_000)
    taken_us = 47_000
    client.run(client.now_us + 2000)
    taken_us = 0
    client.run(client.now_us + 250_000)
    stamps = [int.from_bytes(row[1:4], "little") for row in client.packets(LOG, 2)]
    off_grid = [stamp for stamp in stamps if (stamp - stamps[0]) % 20]
    assert len(off_grid) == 1
    assert max(np.diff(stamps)) > 40


def test_rows_that_a_lost_partner_left_behind_are_dropped(client: CrtpClient, logs) -> None:
    assert client.create(1, logs["pm.vbatMV"][::-1]) == 0
    client.one(LOG, 1, bytes((3, 1, 1)))
    client.polling = client.radio_open = False
    client.run(client.now_us + 900_000)
    assert len(client.firmware.link._transmit) > 80
    client.run(client.now_us + 150_000)
    assert len(client.firmware.link._transmit) == 0
    assert client.firmware.link.dropped == 0


def test_numbers_at_the_edges_of_each_type_are_cast_as_in_c() -> None:
    edges = [
        sign * (2**bits + more) for bits in (7, 8, 15, 16, 31) for more in (-1, 0, 1) for sign in (1, -1)
    ]
    for scalar, c_type in C_TYPES.items():
        assert [scalar.cast(value) for value in edges] == [c_type(value).value for value in edges]
        assert [scalar.cast(value) for value in (inf, -inf, nan, -0.9, 1.9)] == [0, 0, 0, 0, 1]
    for scalar, largest in ((Scalar.F16, 65504.0), (Scalar.F32, float(np.finfo(np.float32).max))):
        found = [scalar.cast(sign * value) for sign in (1, -1) for value in (largest, 2.0 * largest, 1e300)]
        assert found == [largest, inf, inf, -largest, -inf, -inf]


@pytest.mark.long
@given(
    st.sampled_from(sorted(C_TYPES, key=lambda scalar: scalar.log_number)),
    st.integers(-(2**31), 2**32 - 1)
    | st.sampled_from([2**bits - less for bits in (7, 8, 15, 16, 31) for less in (0, 1)]),
)
def test_integers_are_cast_as_in_c(scalar: Scalar, value: int) -> None:
    assert scalar.cast(value) == C_TYPES[scalar](value).value
    assert scalar.unpack(scalar.pack(float(value))) == C_TYPES[scalar](value).value


@pytest.mark.long
@given(st.floats(allow_nan=False))
def test_floats_are_rounded_as_numpy_does(value: float) -> None:
    with np.errstate(over="ignore"):
        assert Scalar.F32.unpack(Scalar.F32.pack(value)) == np.float32(value)
        assert Scalar.F16.unpack(Scalar.F16.pack(value)) == np.float16(value)
    assert Scalar.U8.pack(inf) == Scalar.U8.pack(nan) == b"\0"


@pytest.mark.parametrize("name", ["kalman.fused", "gyro.xVariance"])
def test_a_variable_can_be_fetched_as_every_type_as_c_casts_it(client: CrtpClient, logs, name: str) -> None:
    client.firmware.signals.counters[0] = 70_000  # fits neither 16 bits nor a half float
    client.firmware._core.sampling.fields.variance[0] = 70_000
    for kind, scalar in LOG_SCALARS.items():
        real = inf if scalar is Scalar.F16 else 70_000
        expected = C_TYPES[scalar](70_000).value if scalar in C_TYPES else real
        assert client.log({name: (logs[name][0], kind)}, name) == [expected]


# Parameters


def test_writing_a_parameter_changes_the_running_core(client: CrtpClient, params) -> None:
    core = client.firmware._core.parameters.fields
    assert client.write(params, "RandConsts.flapHoverAng", 0.3) == pytest.approx(0.3)
    assert core.hover_angle == np.float32(0.3)
    assert client.write(params, "motorShifts.m2", -4000) == -4000
    assert list(core.trim) == [-3600, -4000, -9000, 6200]
    assert client.write(params, "delayComp.activate", 0) == core.predict == 0
    client.run(client.now_us + 20_000)
    assert client.writes[-1][1] != HOVER_COUNTS


def test_each_parameter_of_set_point_and_commander_sets_its_own_number(client: CrtpClient, params) -> None:
    for number, name in enumerate(("X", "Y", "Z", "Yaw"), 1):
        client.write(params, f"setpoint.{name}", number / 8)
    assert list(client.firmware._core.parameters.fields.target) == [1 / 8, 2 / 8, 3 / 8, 4 / 8]
    client.write(params, "extCtrl.target_yaw", 0.0)
    assert client.read(params, "setpoint.Yaw") == 0.0
    for name, value in (("vtoff", 0.25), ("vland", 2.0), ("groupmask", 3)):
        client.write(params, f"hlCommander.{name}", value)
    defaults = client.firmware.pilot.stabilizer.high_level.defaults
    assert (defaults.take_off_velocity, defaults.landing_velocity, defaults.groups) == (0.25, 2.0, 3)


def test_what_a_parameter_reads_can_be_written_and_deviations_are_roots_of_variances(
    client: CrtpClient, params
) -> None:
    fields = client.firmware._core.parameters.fields
    for name, field in (("extPosStdDev", "measured_position"), ("extQuatStdDev", "measured_attitude")):
        assert client.write(params, f"locSrv.{name}", 0.25) == 0.25
        assert getattr(fields, field) == 0.0625
    for name, (_, kind) in params.items():
        if not kind & 0x40:
            before = client.read(params, name)
            assert client.write(params, name, before) == pytest.approx(before, rel=1e-6), name


def test_sensors_and_decks_reported_present_are_the_board_s(client: CrtpClient, params) -> None:
    present = {
        name for name in params if name.startswith(("imu_sensors.", "deck.")) and client.read(params, name)
    }
    assert present == {"imu_sensors.BMI088"}


def test_of_absent_decks_the_table_names_those_alone_that_cfclient_and_bitcrazes_suite_read(params) -> None:
    read = {
        *("bcColorLedBot", "bcColorLedTop", "bcDWM1000", "bcFlow", "bcFlow2", "bcLighthouse4", "bcLoco"),
        *("bcZRanger", "bcZRanger2"),
        *("bcLighthouse4", "bcFlow2", "bcMultiranger", "bcUSD", "bcAI", "bcLoco"),  # ALL_DECKS of the suite
    }
    assert {name for name in params if name.startswith("deck.")} == {f"deck.{name}" for name in read}


def test_the_authors_gains_by_their_own_names_are_the_profile_as_flown(client: CrtpClient, params) -> None:
    head = {
        "x": 3.5, "y": 3.5, "z": 3.0, "vx": 0.8, "vy": 0.8, "vz": 0.6, "roll": -0.2, "pitch": -0.15, "yaw": 0.4,
        "roll_rate": -0.18, "pitch_rate": -0.03, "yaw_rate": 0.07,
    }  # fmt: skip
    for name, gain in head.items():
        assert client.write(params, f"extCtrl.{name}_P", gain) == pytest.approx(gain)
    flown = parameters_of(load_config("as-flown")).memory
    ours = client.firmware._core.parameters.memory
    for name in flown.dtype.names:
        if name.startswith("gain_"):
            assert ours[name] == flown[name], name


def test_every_parameter_refuses_bad_values_and_returns_the_one_in_force(client: CrtpClient, params) -> None:
    refused = 0
    for name, (number, kind) in params.items():
        before = client.read(params, name)
        if kind & 0x40:
            assert client.ask(PARAM, 2, struct.pack("<HB", number, 1)) == []
            assert client.read(params, name) == before
        elif kind & 0x0F == 0x06:
            for value in (nan, inf, -inf, 3e38):
                assert client.write(params, name, value) == before, name
                refused += 1
    assert refused > 80
    assert client.write(params, "extCtrl.manual", 3) == 0
    assert client.write(params, "supervisor.poseTimeout", 10) == 500
    assert client.write(params, "motorShifts.m1", 12_001) == -3600
    assert client.write(params, "extCtrl.x_P", 20.5) == client.read(params, "extCtrl.x_P")
    assert "motorShifts.m1 = 12001 refused: allowed -12000..12000 words" in client.console
    beyond = struct.pack("<H", len(params))
    assert client.one(PARAM, 1, beyond) == client.one(PARAM, 2, beyond) == beyond + bytes((errno.ENOENT,))


def test_set_by_name_tells_the_new_value_to_all_and_keeps_it_where_one_is_refused(
    client: CrtpClient, params
) -> None:
    reply, update = client.ask(PARAM, 3, b"\0extCtrl\0z_P\0\x06" + struct.pack("<f", 2.5))
    assert (reply, update) == (
        b"\0extCtrl\0z_P\0\0", b"\1" + struct.pack("<Hf", params["extCtrl.z_P"][0], 2.5)
    )  # fmt: skip
    for wrong in (b"\2\1\0\0\0", b"\x06" + struct.pack("<f", nan)):  # another type of the same size
        assert client.one(PARAM, 3, b"\0extCtrl\0z_P\0" + wrong)[-1:] == bytes((errno.EINVAL,))
    assert client.read(params, "extCtrl.z_P") == 2.5


def test_stored_parameter_survives_a_reboot_and_cleared_one_does_not(client: CrtpClient, params) -> None:
    number, kind = params["extCtrl.z_P"]
    ident = struct.pack("<H", number)
    assert kind & 0x10
    client.write(params, "extCtrl.z_P", 2.0)
    client.write(params, "extCtrl.yaw_P", 0.5)
    assert client.one(PARAM, 3, b"\3" + ident) == b"\3" + ident + b"\0"
    client.write(params, "extCtrl.z_P", 2.25)
    client.reboot()
    assert (client.read(params, "extCtrl.z_P"), client.read(params, "extCtrl.yaw_P")) == (
        2.0,
        pytest.approx(1.2),
    )
    default, stored = struct.pack("<f", 3.0), struct.pack("<f", 2.0)
    assert client.one(PARAM, 3, b"\4" + ident) == b"\4" + ident + b"\1" + default + stored
    assert client.one(PARAM, 3, b"\6" + ident) == b"\6" + ident + default
    assert client.one(PARAM, 3, b"\5" + ident) == b"\5" + ident + b"\0"
    client.reboot()
    assert client.read(params, "extCtrl.z_P") == 3.0


@pytest.mark.parametrize(
    ("command", "persistent", "plain", "constant", "absent"),
    [
        (2, "01", "02", "02", "02"),  # EXTENDED_TYPE: errno 2 is ENOENT
        (7, "0001", "02", "02", "02"),  # with a status
        (6, "{default}", "{default}", "02", "02"),  # DEFAULT
        (8, "00{default}", "00{default}", "02", "02"),  # with a status
        (4, "00{default}", "00{default}", "00{default}", "02"),  # STATE: nothing is stored
        (3, "00", "02", "02", "02"),  # STORE
        (5, "02", "02", "02", "02"),  # CLEAR: the same
    ],
)
def test_each_request_about_a_parameter_has_the_firmware_s_answer_to_its_kind(
    client: CrtpClient, params, command: int, persistent: str, plain: str, constant: str, absent: str
) -> None:
    read_only = next(name for name, (_, kind) in params.items() if kind & TYPE_READ_ONLY)
    for name, form in (("extCtrl.z_P", persistent), ("setpoint.X", plain), (read_only, constant)):
        number, kind = params[name]
        size = PARAMETER_SCALARS[kind & 0x0F].layout.size
        head = struct.pack("<BH", command, number)
        default = client.one(PARAM, 1, head[1:])[-size:].hex()  # nothing was set since the boot
        assert client.one(PARAM, 3, head).hex() == head.hex() + form.format(default=default), name
    head = struct.pack("<BH", command, len(params))
    assert client.one(PARAM, 3, head).hex() == head.hex() + absent


@pytest.mark.long
@given(st.binary(max_size=80), st.integers(0, 200))
@settings(deadline=None)
def test_a_spoilt_store_is_an_empty_one(noise: bytes, place: int) -> None:
    eeprom = bytearray(b"\xff" * 8192)
    storage = ParameterStorage(eeprom)
    assert storage.load() == {}
    values = {f"group.name{k}": bytes((k,) * 4) for k in range(8)}
    assert all(storage.store(name, value) for name, value in values.items())
    assert storage.load() == values
    before = bytes(eeprom)
    eeprom[1024 + place : 1024 + place + len(noise)] = noise
    end = 1024 + 10 + 8 * 17
    assert storage.load() == (values if eeprom[1024:end] == before[1024:end] else {})


CHANGE = st.tuples(st.sampled_from(("a.b", "a.longer", "\xff\x80")), st.none() | st.binary(max_size=255))


@pytest.mark.long
@given(st.lists(CHANGE, max_size=12), st.integers(0, 600))
@example(
    [("a.b", bytes(7)), ("a.b", bytes(8)), ("a.b", b""), ("a.b", None), ("a.b", None)], 12
)  # at 8 a byte too many
@settings(deadline=None)
def test_a_store_has_the_last_value_of_each_name_and_refuses_what_does_not_fit(
    changes: list[tuple[str, bytes | None]], size: int
) -> None:
    storage, kept = ParameterStorage(bytearray(b"\xff" * (1034 + size))), dict[str, bytes]()
    assert storage.size == 10 + size
    for name, value in changes:
        wanted = {**kept, name: value or b""}
        if value is None:
            del wanted[name]
        used = sum(2 + len(one) + len(wanted[one]) for one in wanted)
        done = storage.clear(name) if value is None else storage.store(name, value)
        assert done == (name in kept if value is None else used <= size)
        kept = wanted if done else kept
        assert (storage.load(), storage.used) == (
            kept,
            10 + sum(2 + len(one) + len(kept[one]) for one in kept),
        )


def test_a_store_keeps_the_last_values_up_to_its_last_byte_and_is_empty_once_any_byte_is_spoilt() -> None:
    eeprom = bytearray(b"\xff" * 1100)  # of which the list has the last 76
    store = ParameterStorage(eeprom)
    assert (store.load(), store.size, store.used) == ({}, 76, 10)
    assert [store.store("a.b", bytes((value,))) for value in (1, 2)] == [True, True]
    assert (store.load(), store.used) == ({"a.b": b"\2"}, 16)
    assert not store.store("c.d", bytes(56))
    assert store.load() == {"a.b": b"\2"}
    assert store.store("c.d", bytes(55))
    assert (store.load(), store.used) == ({"a.b": b"\2", "c.d": bytes(55)}, 76)
    for place in range(1024, 1100):
        spoilt = eeprom + b"\xff"
        spoilt[place] ^= 1
        assert ParameterStorage(spoilt).load() == {}
    assert [store.clear("a.b"), store.clear("a.b"), store.load()] == [True, False, {"c.d": bytes(55)}]


def test_of_a_store_only_persistent_parameters_of_the_right_size_count(client: CrtpClient, params) -> None:
    storage = ParameterStorage(client.eeprom)
    assert not params["setpoint.X"][1] & 0x10
    two = struct.pack("<f", 2.0)
    foreign = {
        "setpoint.X": struct.pack("<f", 0.25),
        "extCtrl.y_P": two[:3],
        "extCtrl.z_P": two + b"\0",
        "gone.x": two,
    }
    assert storage.store_all(foreign | {"extCtrl.yaw_P": struct.pack("<f", 0.5)})
    before = {name: client.read(params, name) for name in foreign if name in params}
    client.reboot()
    assert {name: client.read(params, name) for name in before} == before
    assert client.read(params, "extCtrl.yaw_P") == 0.5


# Memories


class Handler:
    """What cflib's memory elements read and write through."""

    def __init__(self, client: CrtpClient) -> None:
        self.client = client

    def read(self, element, address: int, length: int) -> None:
        data = b""
        while len(data) < length:
            step = min(20, length - len(data))
            reply = self.client.one(MEM, 1, struct.pack("<BIB", element.id, address + len(data), step))
            assert reply[:6] == struct.pack("<BIB", element.id, address + len(data), 0)
            data += reply[6:]
        element.new_data(element, address, data)

    def write(self, element, address: int, data, **options) -> None:
        for offset in range(0, len(data), 24):
            piece = bytes(data[offset : offset + 24])
            reply = self.client.one(MEM, 2, struct.pack("<BI", element.id, address + offset) + piece)
            assert reply == struct.pack("<BIB", element.id, address + offset, 0)
        element.write_done(element, address)


@pytest.mark.long
def test_cflib_reads_and_writes_the_configuration_block(client: CrtpClient) -> None:
    element, done = I2CElement(0, 0, 8191, Handler(client)), []
    element.update(done.append)
    assert element.valid
    assert element.elements["radio_address"] == 0xE7E7E7E7E7
    assert (element.elements["radio_channel"], element.elements["radio_speed"]) == (80, 2)
    element.elements["radio_address"] = 0xE7E7E7E701
    element.write_data(lambda *arguments: done.append(arguments))
    client.reboot()
    again = I2CElement(0, 0, 8191, Handler(client))
    again.update(done.append)
    assert again.valid
    assert again.elements["radio_address"] == 0xE7E7E7E701
    poses = [
        struct.pack("<B3hI", address, 0, 0, 0, pack_quaternion((1.0, 0.0, 0.0, 0.0))) for address in (0xE7, 1)
    ]
    for data, taken in (
        (poses[:1], False),
        (poses[1:], True),
        (poses, True),
    ):  # by the last byte of its address
        before = client.firmware.pilot.seen_us
        client.send(LOC, 1, b"\x09" + b"".join(data))
        client.run(client.now_us + 5000)
        assert (client.firmware.pilot.seen_us > before) == taken


def test_memory_tester_gives_the_address_and_counts_wrong_bytes(client: CrtpClient, logs, params) -> None:
    assert client.one(MEM, 1, struct.pack("<BIB", 2, 0x1FA, 10))[6:] == bytes(
        (0xFA, 0xFB, 0xFC, 0xFD, 0xFE, 0xFF, 0, 1, 2, 3)
    )
    assert client.one(MEM, 2, struct.pack("<BI", 2, 0x10) + b"\x10\x11\x12")[-1] == 0
    assert client.log(logs, "memTst.errCntW") == [0]
    assert client.one(MEM, 2, struct.pack("<BI", 2, 0x10) + b"\x10\x99\x98")[-1] == 0
    assert client.log(logs, "memTst.errCntW") == [2]
    assert client.one(MEM, 2, struct.pack("<BI", 2, 0x10) + b"\x99")[-1] == 0
    assert client.log(logs, "memTst.errCntW") == [3]
    assert [len(client.one(MEM, 0, bytes((2, number)))) for number in (4, 5)] == [15, 2]  # the last, and none
    client.write(params, "memTst.resetW", 1)
    assert client.read(params, "memTst.resetW") == 0
    assert client.log(logs, "memTst.errCntW") == [0]


def test_a_refused_kind_is_reported_with_the_count_of_what_was_withheld_since_its_last_line() -> None:
    kernel, lines = SimpleNamespace(now_us=0), []
    notices = Notices(kernel, lines.append)  # type: ignore[arg-type]
    for at_s in (0, 1, 9.999999, 10, 11, 20, 30):
        kernel.now_us = round(1e6 * at_s)
        notices.refuse("kind", f"at {at_s}")
    assert lines == ["at 0", "at 10 (2 more before)", "at 20 (1 more before)", "at 30"]


@pytest.mark.parametrize(
    ("number", "address", "length"),
    [(0, 8191, 1), (0, 8189, 3), (5, 100, 13), (9, 0, 1), (0, 2**32 - 1, 2), (0, 100, 25)],
)
def test_memory_access_outside_fails(client: CrtpClient, number: int, address: int, length: int) -> None:
    head = struct.pack("<BI", number, address)
    assert client.one(MEM, 1, head + bytes((length,))) == head + bytes((errno.EIO,))
    before = bytes(client.eeprom)
    if length < 25:  # more is none of a write's
        assert client.one(MEM, 2, head + bytes(length)) == head + bytes((errno.EIO,))
    assert client.eeprom == before


@pytest.mark.parametrize(("number", "version"), [(3, 3), (4, 1)])
def test_the_memory_of_decks_that_are_not_there_has_a_version_before_its_zeros(
    client: CrtpClient, number: int, version: int
) -> None:
    for address, expected in ((0, bytes((version, 0, 0, 0))), (1, bytes(4))):
        assert client.one(MEM, 1, struct.pack("<BIB", number, address, 4))[5:] == b"\0" + expected


def test_24_bytes_are_read_at_once_up_to_the_last_one(client: CrtpClient) -> None:
    client.eeprom[8167:8191] = bytes(range(24))
    head = struct.pack("<BI", 0, 8191 - 24)
    assert client.one(MEM, 1, head + b"\x18") == head + b"\0" + bytes(range(24))
    assert client.one(MEM, 2, head) == head + b"\0"  # nothing is written, and that is well
    assert client.ask(MEM, 1, head) == []  # a read of no length


# Localisation


unit = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01)


@pytest.mark.parametrize("address", [0xE7E7E7E7E7, 0x1122334455])
def test_of_packed_poses_a_board_takes_those_of_the_last_byte_of_its_address(address: int) -> None:
    client = CrtpClient()
    client.eeprom[:CONFIG_SIZE] = encode_config(RadioSettings(address=address))
    client.reboot()
    for last, seen in (
        (address & 0xFF, True),
        *((address >> 8 * byte & 0xFF ^ 0x80, False) for byte in range(5)),
    ):
        client.firmware.pilot.seen_us = -1
        client.send(LOC, 1, encode_packed_poses(((last, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),)))
        client.run(client.now_us + 5_000)
        assert (client.firmware.pilot.seen_us >= 0) is seen
    if address & 0xFF != address >> 32:
        client.send(LOC, 1, encode_packed_poses(((address >> 32, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),)))
        client.run(client.now_us + 5_000)
        assert client.firmware.pilot.seen_us == -1


@given(unit)
def test_packed_quaternion_is_cflibs(xyzw: tuple[float, ...]) -> None:
    q = np.array(xyzw) / np.linalg.norm(xyzw)
    for packed in (compress_quaternion(xyzw), pack_quaternion((q[3], *q[:3]))):
        w, x, y, z = unpack_quaternion(packed)
        assert abs(np.dot((x, y, z, w), q)) > 1 - 2e-5


# Flaps from outside


def test_power_set_words_reach_the_timers_as_in_the_original(client: CrtpClient, params) -> None:
    vector = json.loads((VECTORS / "servo_word_to_count.json").read_text())
    count_of = dict(zip(vector["words"], vector["counts"], strict=True))
    client.write(params, "motorPowerSet.enable", 1)
    for words in [[0, 65534, 0, 65534], *np.random.default_rng(5).choice(vector["words"], (50, 4)).tolist()]:
        for flap, word in enumerate(words, 1):
            client.write(params, f"motorPowerSet.m{flap}", word)
        client.run(client.now_us + 20_000)
        assert client.writes[-1][1] == [count_of.get(word, 21000 + word * 21000 // 65535) for word in words]


# Console


@pytest.mark.long
@given(st.text(max_size=120))
def test_console_pieces_are_whole_characters_of_at_most_thirty_bytes(text: str) -> None:
    parts = list(pieces(text))
    assert all(len(part) <= 30 for part in parts)
    assert "".join(part.decode() for part in parts) == text.encode("utf-8", "replace").decode()


def test_console_tells_on_the_radio_what_it_tells_on_the_debug_pins(client: CrtpClient) -> None:
    def talk():
        for size in (199, 200, 201, *37 * [150]):  # more than the radio's queue holds
            client.firmware._console.write("x" * size)
        yield from ()

    client.firmware.kernel.create_task("TALK", 1, talk)
    client.radio_open = False
    client.run(100_000)
    client.radio_open = True
    client.run(700_000)
    text = b"".join(client.packets(0, 0)).decode()
    assert text.splitlines() == [line[:200] for line in client.console]
    assert client.console[-1] == "supervisor: waiting"


# What it costs


def test_idle_services_do_not_run(client: CrtpClient) -> None:
    client.run(1_000_000)
    before = {report.name: report.activations for report in client.firmware.reports()}
    client.run(2_000_000)
    after = {report.name: report.activations for report in client.firmware.reports()}
    idle = (
        "SYSLINK", "CRTP-RX", "CRTP-TX", "LOG", "PARAM", "MEM", "CONSOLE", "CRTP-SRV", "PLATFORM-SRV", "APP",
    )  # fmt: skip
    for name in idle:
        assert after[name] == before[name], name
    assert after["PWRMGNT"] - before["PWRMGNT"] == 10


def test_a_burst_of_requests_is_cut_to_the_queues_and_counted(client: CrtpClient) -> None:
    for number in range(100):
        client.send(PARAM, 1, struct.pack("<H", number % 10))
    client.run(client.now_us + 50_000)
    answered = len(client.packets(PARAM, 1))
    assert 0 < answered <= PORT_QUEUE
    assert client.firmware.link.dropped == 100 - answered


def test_queues_have_the_originals_names_and_lengths(client: CrtpClient) -> None:
    queues = {queue.name: queue.length for queue in client.firmware.kernel.queues}
    assert {name: length for name, length in queues.items() if not name.startswith("port")} == {
        "measurements": 20, "syslink": 8, "crtpPacketDelivery": 5, "crtpTx": 120, "console": 40, "app": 10,
    }  # fmt: skip


def test_packets_to_the_board_and_to_all_are_counted_beyond_a_byte(client: CrtpClient, logs) -> None:
    names = "radio.numRxUc", "radio.numRxBc"
    before = client.log(logs, *names)
    for number in range(600):
        client.firmware.radio_received(b"\xf3", broadcast=number % 2 == 1)
        client.run(client.now_us + 1_000)
    unicasts, broadcasts = np.subtract(client.log(logs, *names), before)
    assert (300 <= unicasts < 310, broadcasts) == (True, 300)  # with those that ask for the log
