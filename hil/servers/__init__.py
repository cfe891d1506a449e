"""What leads robots out to real programs: a virtual Crazyradio, UDP, serial lines, Motive, a ground station."""
