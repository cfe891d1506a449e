"""Physics: the rigid body, its plates, servos and battery, the tunnel and its gusts, and the bodies that ship."""
