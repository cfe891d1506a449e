"""The parts of a running board, as its tables of variables and parameters see them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from firmware_py.board import Board
from firmware_py.core_runner import CoreBlocks
from firmware_py.crazyflie.high_level_commander import Defaults
from firmware_py.links.crtp_stack import CrtpStack
from firmware_py.links.memories import Tester
from firmware_py.links.parameters import ParameterStorage
from firmware_py.links.platform import PlatformService
from firmware_py.pilot import Arrived, Pilot
from firmware_py.rtos import Queue
from firmware_py.supervisor import CoreSupervisor

if TYPE_CHECKING:
    from firmware_py.links.mavlink_stack import MavlinkStack


@dataclass(slots=True)
class StockState:
    """Values that clients have set, by name."""

    settings: dict[str, float] = field(default_factory=dict)
    test_value: float = 0.0  # system.testLogParam, shown by sys.testLogParam


@dataclass(frozen=True, slots=True)
class Running:
    """The parts of a running board that variables and parameters read."""

    board: Board
    core: CoreBlocks
    supervisor: CoreSupervisor
    measurements: Queue[Arrived]
    stack: CrtpStack
    platform: PlatformService
    tester: Tester
    storage: ParameterStorage
    pilot: Pilot
    commander: Defaults
    stock: StockState
    print_line: Callable[[str], None]  # on the console
    mavlink: "MavlinkStack | None"
