"""Makes every flight: request, robot, cameras, links, time line, faults, recorder, metrics; and the experiments."""
