"""A whole flight by MAVSDK: connect, telemetry, rates, parameters, arm, take off, offboard by attitude and by rates, stop, land.

Run by the Python that has `mavsdk`: fly_mavsdk.py URL px4|ardupilot. Prints what it saw as one line of JSON.
"""

import asyncio
import json
import sys
import time

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.offboard import Attitude, AttitudeRate

RATES_HZ = {
    "gps_info": 2.0,
    "home": 1.0,
    "landed_state": 5.0,
    "attitude_euler": 50.0,
    "attitude_quaternion": 20.0,
    "imu": 50.0,
    "position_velocity_ned": 20.0,
    "position": 10.0,
}
PERSONALITY = {  # a float and an integer parameter with other values for them
    "px4": {"float": ("MPC_TKO_SPEED", 2.0), "int": ("COM_OBL_ACT", 2)},
    "ardupilot": {"float": ("GUID_TIMEOUT", 2.0), "int": ("GUID_OPTIONS", 8)},
}


async def first(stream, wanted=lambda value: True, seconds=40.0):
    """The first value of a subscription that is wanted."""

    async def look():
        async for value in stream:
            if wanted(value):
                return value

    return await asyncio.wait_for(look(), seconds)


async def rate(stream, seconds=2.0):
    """Values per second."""
    count, end = 0, time.monotonic() + seconds
    async for _ in stream:
        count += 1
        if time.monotonic() > end:
            break
    return count / seconds


async def refused(call):
    """What a call that is refused says."""
    try:
        await call
    except Exception as error:
        return str(error)
    return ""


async def fly(url, personality, seen):
    """The flight; fills `seen`."""
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    await mavsdk.add_any_connection(url)
    system = await mavsdk.first_autopilot(timeout_s=20.0)
    seen["system"] = await system.get_system_id()
    seen["autopilot"] = str(await system.autopilot_type())
    action, telemetry, param, offboard = (kind(system) for kind in (ActionAsync, TelemetryAsync, ParamAsync, OffboardAsync))
    # on ArduPilot, which sends nothing unasked, rc_status brings SYS_STATUS, where health is read
    for name, hz in {**RATES_HZ, **({"rc_status": 2.0} if personality == "ardupilot" else {})}.items():
        await getattr(telemetry, f"set_rate_{name}")(hz)
    seen["set_rate_odometry"] = await refused(telemetry.set_rate_odometry(50.0))
    seen["all_ok"] = await first(telemetry.subscribe_health_all_ok(), bool)
    seen["armable"] = (await first(telemetry.subscribe_health())).is_armable
    for name in ("attitude_euler", "attitude_quaternion", "imu", "position_velocity_ned"):
        seen[f"{name}_hz"] = await rate(getattr(telemetry, f"subscribe_{name}")())
    seen["down_accel_m_s2"] = (await first(telemetry.subscribe_imu())).acceleration_frd.down_m_s2
    here = await first(telemetry.subscribe_position())
    seen["latitude_deg"] = here.latitude_deg

    name, value = PERSONALITY[personality]["float"]
    seen["float_was"] = await param.get_param_float(name)
    await param.set_param_float(name, value)
    seen["float_is"] = await param.get_param_float(name)
    name, value = PERSONALITY[personality]["int"]
    seen["int_was"] = await param.get_param_int(name)
    await param.set_param_int(name, value)
    seen["int_is"] = await param.get_param_int(name)
    everything = await param.get_all_params()
    seen["params"] = len(everything.int_params) + len(everything.float_params)
    seen["no_such_param"] = await refused(param.get_param_float("NO_SUCH_PARAM"))

    await action.set_takeoff_altitude(5.0)
    seen["orbit"] = await refused(action.do_orbit(5.0, 1.0, 0, float("nan"), float("nan"), float("nan")))
    await action.arm()
    seen["armed"] = await first(telemetry.subscribe_armed(), bool)
    await action.takeoff()
    await first(telemetry.subscribe_position(), lambda p: p.relative_altitude_m > 4.5)
    seen["in_air"] = await first(telemetry.subscribe_in_air(), bool)

    thrust = await param.get_param_float("MPC_THR_HOVER" if personality == "px4" else "MOT_THST_HOVER")
    await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, thrust))
    await asyncio.sleep(1.5)
    await offboard.start()
    seen["active"] = await offboard.is_active()
    await offboard.set_attitude(Attitude(10.0, 0.0, 0.0, thrust))
    await asyncio.sleep(1.5)
    seen["roll_deg"] = (await first(telemetry.subscribe_attitude_euler())).roll_deg
    await offboard.set_attitude(Attitude(-10.0, 0.0, 0.0, thrust))
    await asyncio.sleep(1.5)
    await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, thrust))
    await asyncio.sleep(1.0)
    before = (await first(telemetry.subscribe_attitude_euler())).yaw_deg
    await offboard.set_attitude_rate(AttitudeRate(0.0, 0.0, 30.0, thrust))
    await asyncio.sleep(2.0)
    seen["turned_deg"] = ((await first(telemetry.subscribe_attitude_euler())).yaw_deg - before) % 360.0
    seen["flight_mode"] = str(await first(telemetry.subscribe_flight_mode()))
    await offboard.stop()
    await asyncio.sleep(1.5)
    seen["active_after"] = await offboard.is_active()
    seen["mode_after"] = str(await first(telemetry.subscribe_flight_mode()))
    await action.land()
    await first(telemetry.subscribe_in_air(), lambda air: not air)
    await first(telemetry.subscribe_armed(), lambda armed: not armed)
    await action.arm()
    await action.disarm()
    seen["disarmed"] = not await first(telemetry.subscribe_armed(), lambda armed: not armed)
    seen["done"] = True


def main():
    """Fly and say what was seen, also when something fails."""
    seen = {"done": False}
    try:
        asyncio.run(asyncio.wait_for(fly(sys.argv[1], sys.argv[2], seen), 150.0))
    except Exception as error:
        seen["error"] = f"{type(error).__name__}: {error}"
    print(json.dumps(seen), flush=True)


if __name__ == "__main__":
    main()
