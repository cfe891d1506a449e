"""Everything that runs on the microcontroller: flight core, scheduler, drivers, links and the tasks that join them."""
