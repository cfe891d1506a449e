"""The robot as a design: its trim, its linear dynamics and authority, sweeps over its shape, and better shapes."""
