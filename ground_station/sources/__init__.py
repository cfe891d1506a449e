"""The sources of poses, one file per system; each is a `ground_station.mocap.MocapSource`."""
