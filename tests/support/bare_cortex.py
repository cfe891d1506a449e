"""A Cortex-M4F of memory and nothing else, as unicorn has it: what a debugger is tried on."""

from unicorn import UC_ARCH_ARM, UC_HOOK_CODE, UC_MODE_MCLASS, UC_MODE_THUMB, Uc, UcError
from unicorn import arm_const as arm

from hil.errors import LabError
from hil.stm32f405.gdb import GdbServer
from hil.stm32f405.gdb_protocol import REGISTERS, SIGINT, SIGTRAP, Wish
from hil.stm32f405.image import Image

SLICE = 1000  # instructions between two looks at the debugger
NUMBERS = {name: getattr(arm, f"UC_ARM_REG_{name.upper()}") for name, _ in REGISTERS}


class BareCortex:
    """Flash, RAM, and silent memory where peripherals are; runs from the image's reset on."""

    def __init__(self, image: Image) -> None:
        self.breakpoints: set[int] = set()
        self._uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS)
        self._uc.ctl_set_cpu_model(arm.UC_CPU_ARM_CORTEX_M4)
        for base, size in (
            (0x0800_0000, 1 << 20),
            (0x2000_0000, 1 << 17),
            (0x4000_0000, 1 << 18),
            (0xE000_0000, 1 << 16),
        ):
            self._uc.mem_map(base, size)
        self._uc.mem_write(image.base, image.code)
        self._uc.hook_add(UC_HOOK_CODE, self._at)
        self._leaving = 0
        self.set_register("sp", image.initial_stack_pointer)
        self.set_register("pc", image.reset)

    def watch(self, kind: int, address: int, size: int, on: bool) -> None:
        raise LabError("no watchpoints")

    def read(self, address: int, size: int) -> bytes:
        try:
            return bytes(self._uc.mem_read(address, size))
        except UcError as error:
            raise LabError(f"0x{address:08x}: {error}") from None

    def write(self, address: int, data: bytes) -> None:
        try:
            self._uc.mem_write(address, data)
        except UcError as error:
            raise LabError(f"0x{address:08x}: {error}") from None

    def register(self, name: str) -> int:
        return int(self._uc.reg_read(NUMBERS[name]))

    def set_register(self, name: str, value: int) -> None:
        self._uc.reg_write(NUMBERS[name], value)

    def run_for(self, server: GdbServer) -> None:
        """Be the machine of a debugger until it leaves."""
        server.attach(self)
        self.run(server)

    def run(self, server: GdbServer) -> Wish:
        """Do what the debugger wants until it leaves."""
        signal = SIGTRAP
        while (wish := server.hold(signal)) in (Wish.RUN, Wish.STEP):
            signal = self._step() if wish is Wish.STEP else self.run_to_stop(server)
        return wish

    def run_to_stop(self, server: GdbServer) -> int:
        """Run as far as a breakpoint or the debugger's Ctrl-C; returns the signal."""
        self._leaving = self.register("pc")
        while True:
            self._uc.emu_start(self.register("pc") | 1, 0xFFFF_FFFF, count=SLICE)
            if self.register("pc") in self.breakpoints:
                return SIGTRAP
            if server.wants_to_stop():
                return SIGINT

    def _step(self) -> int:
        self._leaving = self.register("pc")
        self._uc.emu_start(self._leaving | 1, 0xFFFF_FFFF, count=1)
        return SIGTRAP

    def _at(self, uc: Uc, address: int, size: int, data: object) -> None:
        """Stop in front of a breakpoint, but not of the one where the run begins."""
        if address in self.breakpoints and address != self._leaving:
            uc.emu_stop()
        self._leaving = 0
