"""From a run folder to files of other programs: a wide table, MCAP, a telemetry log of MAVLink; reads run folders only."""
