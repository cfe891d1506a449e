"""Every log variable and parameter of the stock firmware that clients use is there, with its type, and means the same."""

import json
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core import entry
from firmware_py.core.structs import Input, Sampling
from firmware_py.wire import crtp
from firmware_py.wire.scalars import LOG_SCALARS, PARAMETER_SCALARS
from support.crtp_client import LOG, PARAM, CrtpClient
from support.paths import VECTORS

STOCK = json.loads((VECTORS / "stock_names.json").read_text())
READ_ONLY, EXTENDED = 0x40, 0x10
BUTTONS = {
    "system.taskDump": "Task dump",
    "system.storageStats": "Used storage: 0 items stored, 10 of 7168 bytes (0 %)",
    "system.assertInfo": "No assert information found",
    "health.startPropTest": "health: there are no propellers to test",
    "health.startBatTest": "health: battery 3900 mV, at least 3200 needed",
}


@pytest.fixture
def client() -> CrtpClient:
    return CrtpClient()


@pytest.fixture(scope="module")
def tables() -> tuple[dict[str, tuple[int, int]], dict[str, tuple[int, int]]]:
    client = CrtpClient()
    return client.toc(LOG), client.toc(PARAM)


def test_every_log_variable_that_clients_use_has_its_stock_type(tables) -> None:
    logs, _ = tables
    types = {name: LOG_SCALARS[kind].name for name, (_, kind) in logs.items()}
    assert {name: types.get(name) for name in STOCK["log"]} == STOCK["log"]


def test_every_parameter_that_clients_use_has_its_stock_type_access_and_persistence(tables) -> None:
    _, params = tables
    texts = {
        name: PARAMETER_SCALARS[kind & 0x0F].name
        + " read only" * bool(kind & READ_ONLY)
        + " persistent" * bool(kind & EXTENDED)
        for name, (_, kind) in params.items()
    }
    assert {name: texts.get(name) for name in STOCK["parameters"]} == STOCK["parameters"]


def test_parameters_without_effect_keep_values_and_persistence(client: CrtpClient, tables) -> None:
    _, params = tables
    for name, value in (
        ("pid_attitude.pitch_kd", 0.25),
        ("stabilizer.estimator", 1),
        ("stabilizer.controller", 2),
    ):
        assert client.write(params, name, value) == value
        assert client.read(params, name) == value
    for name in ("pid_attitude.pitch_kd", "ring.effect"):
        client.write(params, name, 7)
        assert client.one(PARAM, 3, b"\x03" + struct.pack("<H", params[name][0]))[3:] == b"\0"
    client.reboot()
    assert client.read(params, "pid_attitude.pitch_kd") == client.read(params, "ring.effect") == 7
    assert client.read(params, "stabilizer.controller") == 0


@pytest.mark.parametrize("name", BUTTONS)
def test_a_button_prints_once_and_reads_zero_again(client: CrtpClient, tables, name: str) -> None:
    _, params = tables
    assert client.write(params, name, 1) == 0
    client.run(client.now_us + 200_000)
    assert client.console.count(BUTTONS[name]) == 1
    assert client.write(params, name, 0) == 0
    client.run(client.now_us + 200_000)
    assert client.console.count(BUTTONS[name]) == 1


def test_the_task_dump_names_every_task_with_its_load(client: CrtpClient, tables) -> None:
    _, params = tables
    client.run(1_000_000)
    client.sent.clear()
    client.write(params, "system.taskDump", 1)
    client.run(client.now_us + 500_000)
    text = b"".join(client.packets(0, 0)).decode()
    rows = dict(reversed(line.split("\t")) for line in text.splitlines() if "\t" in line)
    kernel = client.firmware.kernel
    assert rows.keys() - {"Name"} == {task.name for task in kernel.tasks}
    shares = {name: float(share) for name, share in rows.items() if name != "Name"}
    assert sum(shares.values()) == pytest.approx(100, abs=0.2)  # with what nobody took
    kalman = next(task for task in kernel.tasks if task.name == "KALMAN")
    assert shares["KALMAN"] == pytest.approx(100 * kernel.run_time_us(kalman) / client.now_us, rel=0.1)


def test_the_set_value_of_the_test_parameter_is_logged(client: CrtpClient, tables) -> None:
    logs, params = tables
    client.write(params, "system.testLogParam", 42)
    assert client.log(logs, "sys.testLogParam") == [42]


def test_the_target_is_logged_where_stock_controllers_log_theirs(client: CrtpClient, tables) -> None:
    logs, params = tables
    for name, value in (("setpoint.X", 0.1), ("setpoint.Y", 0.2), ("setpoint.Z", 0.3), ("setpoint.Yaw", 0.5)):
        client.write(params, name, value)
    assert client.log(logs, "ctrltarget.x", "ctrltarget.y", "ctrltarget.z") == pytest.approx([0.1, 0.2, 0.3])
    turned = client.log(logs, "posCtl.targetX", "posCtl.targetY", "posCtl.targetZ")
    assert turned == pytest.approx([0.1, 0.2, 0.3], abs=1e-4)
    yaw = Rotation.from_euler("z", 90, degrees=True).as_quat().tolist()
    data = crtp.encode_ext_pose((0.0, 0.0, 0.0), (yaw[3], *yaw[:3]), 40_000)
    client.events.at(605_000, lambda now_us: client.firmware.radio_received(data))
    client.run(630_000)
    turned = client.log(logs, "posCtl.targetX", "posCtl.targetY", "posCtl.targetZ")
    assert turned == pytest.approx([0.2, -0.1, 0.3], abs=1e-3)
    assert client.log(logs, "controller.yaw") == pytest.approx([28.6479])


def test_a_battery_passes_from_the_voltage_on_at_which_it_counts_as_low(client: CrtpClient) -> None:
    (passes,) = [one for one in client.firmware.variables if one.name == "health.batteryPass"]
    for millivolts, expected in ((3199, False), (3200, True), (4000, True)):
        client.firmware._core.data.fields.battery_mv = millivolts
        assert passes.read() == expected


def test_the_radio_counts_what_came_to_this_board_and_to_all(client: CrtpClient, tables) -> None:
    logs, _ = tables
    before = client.log(logs, "radio.numRxUc", "radio.numRxBc")
    for _ in range(3):
        client.firmware.radio_received(b"\xff", broadcast=True)
        client.run(client.now_us + 5000)
    after = client.log(logs, "radio.numRxUc", "radio.numRxBc")
    assert after[1] - before[1] == 3
    assert after[0] - before[0] == 6  # the requests themselves
    assert client.log(logs, "radio.isConnected", "radio.rssi") == [1, 40]


def test_the_gyros_variance_is_that_of_the_samples_its_zero_is_from() -> None:
    rng = np.random.default_rng(1)
    samples = np.rint(rng.normal(0, (1.0, 2.0, 0.5), (512, 3))).astype(int).tolist()
    data, sampling = Input.allocate(), Sampling.allocate()
    for number, sample in enumerate(samples):
        data.fields.gyro[:] = sample
        assert entry.take_sample(data.fields, sampling.fields) == (number == 511)
    assert sampling.fields.variance == pytest.approx(np.var(samples, axis=0), rel=1e-5)
