"""The names of our parameters in MAVLink: at most 16 characters, upper case, unique.

The rule: the group's abbreviation, `_`, the name in upper case, cut at 16.
"""

NAME_SIZE = 16

PREFIXES = {
    "extCtrl": "EXT",
    "motorPowerSet": "PWR",
    "motorShifts": "TRIM",
    "setpoint": "SP",
    "RandConsts": "RND",
    "delayComp": "DLY",
    "kalman": "KAL",
    "FloatyKalm": "FKL",
    "locSrv": "LOC",
    "stabilizer": "STAB",
    "supervisor": "SUP",
    "telemetry": "TLM",
    "memTst": "MEM",
    "deck": "DK",
    "imu_sensors": "IMU",
    "firmware": "FW",
}


def mavlink_name(name: str) -> str:
    """The MAVLink name of parameter `group.name`; a group that is not in the table keeps its own name."""
    group, _, own = name.partition(".")
    return f"{PREFIXES.get(group, group)}_{own}".upper()[:NAME_SIZE]
