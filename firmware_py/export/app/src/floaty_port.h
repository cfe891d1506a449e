/* Executes the flight core call by call for a host, on memory of its own; firmware_py/wire/core_port.py has the packets. */
#pragma once

/* Serves the port from now on. */
void floaty_port_init(void);
