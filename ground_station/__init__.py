"""The computer beside the tunnel: it receives mocap frames and telemetry, and sends corrections."""

from firmware_py import fast as fast  # lets compiled modules be found
