"""The flying body: plates in the flow, rigid body, servos, tether. `hil.plant.plant.Plant` is what the harness talks to."""
