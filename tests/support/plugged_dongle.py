"""The virtual Crazyradio of a server, in this process."""

import cflib.crtp
import libusb_package
from cflib.crtp.radiodriver import RadioManager

from hil.servers.dongle_plugin import VARIABLE, Backend
from support.serving import Served


def plug(served: Served) -> None:
    """Put the dongle of a server into this process."""
    backend = Backend(served.environment[VARIABLE])
    libusb_package.get_libusb1_backend = lambda: backend
    RadioManager._radios.clear()
    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()
