"""A MAVSDK program in a process of its own: `mavsdk_client.py URL PARAMETER VALUE` prints what it saw as JSON."""

import asyncio
import json
import math
import sys

from mavsdk.asyncio import Configuration, Mavsdk
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.mocap import MocapAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.component_type import ComponentType
from mavsdk.plugins.mocap import Covariance, Odometry, PositionBody, Quaternion


async def first(stream):
    """The first item of a stream."""
    async for item in stream:
        return item


async def requested(telemetry, kind):
    """The first item of a stream that the board sends on request."""
    await getattr(telemetry, f"set_rate_{kind}")(10.0)
    return await first(getattr(telemetry, f"subscribe_{kind}")())


async def fly_on_odometry(system, telemetry):
    """Send poses at home until the board says that it is in the air."""
    mocap, unknown = MocapAsync(system), Covariance([math.nan])
    pose = Odometry(
        frame_id=Odometry.MavFrame.LOCAL_FRD,
        position_body=PositionBody(0.0, 0.0, -1.15),
        q=Quaternion(1.0, 0.0, 0.0, 0.0),
        pose_covariance=unknown,
        velocity_covariance=unknown,
        estimator_type=Odometry.MavEstimatorType.MOCAP,
    )

    async def send():
        while True:
            await mocap.set_odometry(pose)
            await asyncio.sleep(0.02)

    sending = asyncio.create_task(send())
    async for in_air in telemetry.subscribe_in_air():
        if in_air:
            break
    sending.cancel()


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

        odometry, imu = await requested(telemetry, "odometry"), await requested(telemetry, "imu")
        home, position = await requested(telemetry, "home"), await requested(telemetry, "position")
        seen["odometry"] = [getattr(odometry.position_body, f"{axis}_m") for axis in "xyz"]
        seen["imu"] = [getattr(imu.acceleration_frd, f"{axis}_m_s2") for axis in ("forward", "right", "down")]
        seen["home"] = [home.local_north_m, home.local_east_m, home.local_down_m]
        velocity = await requested(telemetry, "velocity_ned")
        seen["velocity"] = [velocity.north_m_s, velocity.east_m_s, velocity.down_m_s]
        seen["height"] = position.relative_altitude_m
        seen["heading_deg"] = (await first(telemetry.subscribe_heading())).heading_deg
        seen["in_air"] = await requested(telemetry, "in_air")
        seen["landed_state"] = (await requested(telemetry, "landed_state")).name
        seen["armed"] = await first(telemetry.subscribe_armed())

        version = await InfoAsync(system).get_version()
        seen["version"] = [version.flight_sw_major, version.flight_sw_minor, version.flight_sw_patch]

        param = ParamAsync(system)
        everything = await param.get_all_params()
        seen["floats"] = {entry.name: entry.value for entry in everything.float_params}
        seen["others"] = len(everything.int_params) + len(everything.custom_params)
        seen["before"] = await param.get_param_float(parameter)
        await param.set_param_float(parameter, value)
        seen["after"] = await param.get_param_float(parameter)

        await fly_on_odometry(system, telemetry)
    print(json.dumps(seen))


asyncio.run(main(sys.argv[1], sys.argv[2], float(sys.argv[3])))
