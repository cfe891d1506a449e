"""The computer beside the tunnel: a mocap frame arrives, a correction leaves, telemetry comes back."""

from firmware_py import fast as fast  # lets compiled modules be found
