"""Writes run folders in formats of other programs: a wide table, MCAP, a MAVLink telemetry log; reads only run folders."""
