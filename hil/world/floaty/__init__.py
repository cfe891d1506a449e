"""Floaty: its shape, its plates in the flow, its identified correction, and its drawing."""
