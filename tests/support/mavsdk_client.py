"""A MAVSDK program in a process of its own: `mavsdk_client.py URL PARAMETER VALUE` prints what it saw as JSON."""

import asyncio
import json
import sys

from mavsdk.asyncio import Configuration, Mavsdk
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.component_type import ComponentType


async def first(stream):
    """The first item of a stream."""
    async for item in stream:
        return item


async def main(url, parameter, value):
    seen = {}
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(url)
        system = await mavsdk.first_autopilot(timeout_s=10.0)
        assert system is not None, "no autopilot within 10 s"
        seen["system"] = await system.get_system_id()

        telemetry = TelemetryAsync(system)
        attitude = await first(telemetry.subscribe_attitude_euler())
        quaternion = await first(telemetry.subscribe_attitude_quaternion())
        motion = await first(telemetry.subscribe_position_velocity_ned())
        battery = await first(telemetry.subscribe_battery())
        seen["attitude_deg"] = [attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg]
        seen["quaternion"] = [quaternion.w, quaternion.x, quaternion.y, quaternion.z]
        seen["position"] = [motion.position.north_m, motion.position.east_m, motion.position.down_m]
        seen["battery_V"] = battery.voltage_v

        version = await InfoAsync(system).get_version()
        seen["version"] = [version.flight_sw_major, version.flight_sw_minor, version.flight_sw_patch]

        param = ParamAsync(system)
        everything = await param.get_all_params()
        seen["floats"] = {entry.name: entry.value for entry in everything.float_params}
        seen["others"] = len(everything.int_params) + len(everything.custom_params)
        seen["before"] = await param.get_param_float(parameter)
        await param.set_param_float(parameter, value)
        seen["after"] = await param.get_param_float(parameter)
    print(json.dumps(seen))


asyncio.run(main(sys.argv[1], sys.argv[2], float(sys.argv[3])))
