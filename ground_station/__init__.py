"""The computer beside the tunnel: a mocap frame arrives, a correction leaves, telemetry comes back."""
