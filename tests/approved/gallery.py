"""An experiment with all pictures that experiments have."""

from dataclasses import replace

from hil.laboratory.experiments import EXPERIMENTS
from hil.pictures.gallery import GALLERY

EVERY = replace(EXPERIMENTS["overload"], name="every", pictures=tuple(GALLERY))
