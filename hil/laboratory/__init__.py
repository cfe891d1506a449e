"""Assembles robot, cameras, links and time line for every flight: in lockstep, paced over a real link, or served."""
