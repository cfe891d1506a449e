"""Where poses come from, one file per system; each is a `ground_station.mocap.MocapSource`."""
