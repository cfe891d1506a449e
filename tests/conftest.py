"""Property tests try the same examples on every machine, and look for new ones with FLOATY_FUZZ set; `-n auto` is one
worker more than there are processors, because a third of the time is spent waiting for flights in real time.
"""

import os

from hypothesis import settings

settings.register_profile("reproducible", derandomize=True)
if "FLOATY_FUZZ" not in os.environ:
    settings.load_profile("reproducible")


def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers of `-n auto`."""
    return (os.cpu_count() or 1) + 1
