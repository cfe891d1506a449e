"""The computer beside the tunnel: it receives mocap frames and telemetry, and sends corrections."""
