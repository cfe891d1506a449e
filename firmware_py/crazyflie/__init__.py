"""What the Crazyflie firmware decides around the flight core: commander, high-level commander, planner and supervisor.

Each file is named after its source in crazyflie-firmware 2a18fc29 and knows nothing of Floaty. The referee is that
firmware in the emulator: `tests/conformance/test_services.py`.
"""
