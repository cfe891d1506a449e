"""A MAVSDK program in a process of its own, for a board that flies: `mavsdk_pilot.py URL` prints what became of it."""

import asyncio
import json
import sys

from mavsdk.asyncio import Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.failure import FailureAsync
from mavsdk.asyncio.plugins.log_files import LogFilesAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.component_type import ComponentType
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.failure import FailureType, FailureUnit


async def outcome(call):
    """What a request comes to, in a word."""
    try:
        await call
    except MavsdkError as error:
        return error.result.name
    return "done"


async def armed_is(telemetry, wanted):
    """Wait until the heartbeat says so."""
    async for armed in telemetry.subscribe_armed():
        if armed == wanted:
            return "armed" if armed else "disarmed"


async def main(url):
    seen = {"texts": []}
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(url)
        system = await mavsdk.first_autopilot(timeout_s=10.0)
        assert system is not None, "no autopilot within 10 s"
        telemetry, action, failure = TelemetryAsync(system), ActionAsync(system), FailureAsync(system)

        async def listen():
            async for line in telemetry.subscribe_status_text():
                seen["texts"].append(line.text)

        listening = asyncio.create_task(listen())
        await telemetry.set_rate_landed_state(10.0)
        async for state in telemetry.subscribe_landed_state():
            if state.name != "UNKNOWN":
                seen["landed_state"] = state.name
                break
        async for seen["in_air"] in telemetry.subscribe_in_air():
            break

        await failure.inject(FailureUnit.SENSOR_VIO, FailureType.OFF, 0)
        seen["without poses"] = await armed_is(telemetry, False)
        await failure.inject(FailureUnit.SENSOR_VIO, FailureType.OK, 0)
        seen["with poses"] = await armed_is(telemetry, True)
        seen["gps"] = await outcome(failure.inject(FailureUnit.SENSOR_GPS, FailureType.OFF, 0))

        param = ParamAsync(system)
        seen["clear mission"] = await outcome(MissionRawAsync(system).clear_mission())
        seen["logs"] = await outcome(LogFilesAsync(system).get_entries())
        seen["unknown parameter"] = await outcome(param.get_param_float("NONE"))
        seen["parameter out of range"] = await outcome(param.set_param_float("EXT_Z_P", 1e9))

        await action.terminate()
        await armed_is(telemetry, False)
        seen["arm after the stop"] = await outcome(action.arm())
        await action.reboot()
        while (await outcome(action.arm())) != "done":
            await asyncio.sleep(0.1)
        listening.cancel()
    print(json.dumps(seen))


asyncio.run(main(sys.argv[1]))
