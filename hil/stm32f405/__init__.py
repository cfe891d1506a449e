"""A microcontroller, which executes an image as it is flashed, and what is read of it while it runs."""
