"""Everything that runs on the microcontroller: flight core, scheduler, drivers, links and the tasks that join them."""

from firmware_py import fast as fast  # lets compiled modules be found
