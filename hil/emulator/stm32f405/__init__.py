"""A microcontroller that executes a flashed image, and tools that inspect it while it runs."""
