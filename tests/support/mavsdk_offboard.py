"""MAVSDK's offboard in its own process: `mavsdk_offboard.py URL` prints the outcome as JSON.

The calls are those of MAVSDK's example `offboard_position_ned.py`, with other distances; then what else a client may try.
"""

import asyncio
import json
import sys
import time

from mavsdk.asyncio import Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.mission import MissionAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync, PositionNedYaw, VelocityNedYaw
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.component_type import ComponentType
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.mission import MissionItem, MissionPlan
from mavsdk.plugins.mission_raw import MissionItem as RawItem

GOALS = (  # north, east, down [m], yaw [deg], and for how long [s]
    (0.0, 0.0, -1.3, 0.0, 4.5),
    (0.1, 0.0, -1.3, 90.0, 4.5),
    (0.1, 0.1, -1.3, 90.0, 4.5),
    (0.0, 0.1, -1.15, 180.0, 4.5),
)
STREAMS = (
    "odometry", "position_velocity_ned", "actuator_output_status", "home", "fixedwing_metrics", "unix_epoch_time",
    "attitude_euler", "attitude_quaternion", "battery", "flight_mode", "armed", "health",
)  # fmt: skip


async def outcome(call):
    """What a request comes to, in a word."""
    try:
        await call
    except MavsdkError as error:
        return error.result.name
    return "done"


async def first(stream, timeout_s=12.0):
    """Whether a stream has an item within some time."""

    async def item():
        async for _ in stream:
            return True

    try:
        return await asyncio.wait_for(item(), timeout_s)
    except TimeoutError:
        return False


async def mode_is(telemetry, wanted):
    """Wait for a flight mode."""
    async for mode in telemetry.subscribe_flight_mode():
        if mode.name == wanted:
            return mode.name


async def main(url):
    seen = {"texts": [], "places": [], "goals": []}
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(url)
        drone = await mavsdk.first_autopilot(timeout_s=10.0)
        assert drone is not None, "no autopilot within 10 s"
        telemetry, action, offboard = TelemetryAsync(drone), ActionAsync(drone), OffboardAsync(drone)

        async def listen():
            async for line in telemetry.subscribe_status_text():
                seen["texts"].append(line.text)

        async def watch():
            async for motion in telemetry.subscribe_position_velocity_ned():
                p = motion.position
                seen["places"].append((time.monotonic(), p.north_m, p.east_m, p.down_m))

        tasks = [asyncio.create_task(listen()), asyncio.create_task(watch())]
        found = asyncio.gather(*(first(getattr(telemetry, f"subscribe_{name}")()) for name in STREAMS))
        await telemetry.set_rate_position_velocity_ned(20.0)

        seen["arm"] = await outcome(action.arm())
        await offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -1.15, 0.0))
        seen["start"] = await outcome(offboard.start())
        seen["mode in offboard"] = await mode_is(telemetry, "OFFBOARD")
        for north, east, down, yaw, duration_s in GOALS:
            await offboard.set_position_ned(PositionNedYaw(north, east, down, yaw))
            begin = time.monotonic()
            await asyncio.sleep(duration_s)
            seen["goals"].append((begin, time.monotonic(), north, east, down))
        seen["active"] = await offboard.is_active()
        seen["stop"] = await outcome(offboard.stop())
        seen["mode after"] = await mode_is(telemetry, "HOLD")

        await offboard.set_velocity_ned(VelocityNedYaw(0.1, 0.0, 0.0, 0.0))
        await asyncio.sleep(0.5)
        await offboard.stop()
        item = RawItem(0, 6, 16, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0)
        seen["raw mission"] = await outcome(MissionRawAsync(drone).upload_mission([item]))
        point = MissionItem(
            latitude_deg=0.0, longitude_deg=0.0, relative_altitude_m=1.0, speed_m_s=1.0, is_fly_through=True,
            camera_action=MissionItem.CameraAction.NONE, vehicle_action=MissionItem.VehicleAction.NONE,
        )  # fmt: skip
        seen["mission"] = await outcome(MissionAsync(drone).upload_mission(MissionPlan([point])))
        seen["start mission"] = await outcome(MissionAsync(drone).start_mission())
        seen["streams"] = dict(zip(STREAMS, await found, strict=True))
        for task in tasks:
            task.cancel()
    print(json.dumps(seen))


asyncio.run(main(sys.argv[1]))
