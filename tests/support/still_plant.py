"""A plant held in calm air."""

import numpy as np

from hil.world.config import GeometryConfig, PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.plant import Plant


def still_plant() -> Plant:
    calm = TunnelConfig(turbulence="none")
    plant = Plant(GeometryConfig(), PlantConfig(), calm, PlantServoConfig(), np.random.default_rng(1))
    plant.hold()
    return plant
