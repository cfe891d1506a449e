"""Connects robots to real programs: by a virtual Crazyradio, UDP, serial lines, Motive, or a ground station."""
