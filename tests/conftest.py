"""Property tests try the same examples on every machine; with FLOATY_FUZZ set they look for new ones."""

import os

from hypothesis import settings

settings.register_profile("reproducible", derandomize=True)
if "FLOATY_FUZZ" not in os.environ:
    settings.load_profile("reproducible")
