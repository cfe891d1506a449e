"""The supervisor: a state machine that decides 25 times per second whether the motors may run (supervisor.c).

Transitions are rows of a table (supervisor_state_machine.c). The board arms itself whenever its pre-flight checks pass.
Time is in ms ticks. Without here: faults of decks and speeds of motors, which this board does not measure.
"""

from dataclasses import dataclass
from enum import Enum, IntFlag, auto

from firmware_py.crazyflie.commander import NULL, Setpoint
from firmware_py.geometry import Vector

LEVEL_OUT_MS, LOCK_MS = 500, 2000  # age of the set-point in flight
FLYING_MS = 2000  # since a motor was last over its idle thrust
PREFLIGHT_MS, LANDED_MS = 30_000, 3000
WATCHDOG_MS = 1000  # of the emergency stop
FREE_FALL_G, TILT_G, UPSIDE_DOWN_G = 0.1, 0.5, -0.2  # specific force along z
TILT_MS, UPSIDE_DOWN_MS = 1000, 100


class State(Enum):
    """The states, by the firmware's names."""

    NOT_INITIALIZED = auto()
    CHECKS_NOT_PASSED = auto()
    CHECKS_PASSED = auto()
    ARMING = auto()
    READY = auto()
    FLYING = auto()
    LANDED = auto()
    RESET = auto()
    LEVEL_OUT = auto()
    FREE_FALL = auto()
    LOCKED = auto()
    CRASHED = auto()


class Condition(IntFlag):
    """What a transition asks for."""

    NONE = 0
    ARMED = auto()
    FLYING = auto()
    TUMBLED = auto()
    OLD_SETPOINT = auto()
    NO_SETPOINT = auto()
    STOP = auto()
    CRASHED = auto()
    PREFLIGHT_TIMEOUT = auto()
    LANDING_TIMEOUT = auto()


@dataclass(frozen=True, slots=True)
class Transition:
    """Leads to a state: with any of `any`, or without `missing`; or, if both are empty, with `all` and none of `but`."""

    to: State
    any: Condition = Condition.NONE
    missing: Condition = Condition.NONE
    all: Condition = Condition.NONE
    but: Condition = Condition.NONE

    def applies(self, now: Condition) -> bool:
        if self.any or self.missing:
            return bool(now & self.any) or (now & self.missing) != self.missing
        return (now & self.all) == self.all and not now & self.but


_C, _S = Condition, State
_STOP = Transition(_S.FREE_FALL, any=_C.STOP)
TRANSITIONS = {
    _S.NOT_INITIALIZED: (Transition(_S.CHECKS_NOT_PASSED),),
    _S.CHECKS_NOT_PASSED: (_STOP, Transition(_S.CHECKS_PASSED, but=_C.TUMBLED)),
    _S.CHECKS_PASSED: (
        _STOP,
        Transition(_S.CHECKS_NOT_PASSED, any=_C.TUMBLED),
        Transition(_S.ARMING, all=_C.ARMED, but=_C.TUMBLED),
    ),
    _S.ARMING: (
        _STOP,
        Transition(_S.CHECKS_NOT_PASSED, any=_C.TUMBLED, missing=_C.ARMED),
        Transition(_S.READY),
    ),
    _S.READY: (
        _STOP,
        Transition(_S.CHECKS_NOT_PASSED, any=_C.TUMBLED | _C.PREFLIGHT_TIMEOUT, missing=_C.ARMED),
        Transition(_S.FLYING, all=_C.FLYING),
    ),
    _S.FLYING: (
        Transition(_S.FREE_FALL, any=_C.NO_SETPOINT | _C.STOP),
        Transition(_S.CRASHED, any=_C.TUMBLED),
        Transition(_S.RESET, but=_C.ARMED),
        Transition(_S.LEVEL_OUT, all=_C.OLD_SETPOINT),
        Transition(_S.LANDED, but=_C.FLYING),
    ),
    _S.LANDED: (
        Transition(_S.RESET, any=_C.LANDING_TIMEOUT, missing=_C.ARMED),
        Transition(_S.FLYING, all=_C.FLYING),
    ),
    _S.RESET: (Transition(_S.CHECKS_NOT_PASSED),),
    _S.LEVEL_OUT: (
        Transition(_S.FREE_FALL, any=_C.NO_SETPOINT | _C.TUMBLED | _C.STOP),
        Transition(_S.FLYING, but=_C.OLD_SETPOINT | _C.NO_SETPOINT),
    ),
    _S.FREE_FALL: (Transition(_S.LOCKED),),
    _S.LOCKED: (),
    _S.CRASHED: (
        Transition(_S.CHECKS_NOT_PASSED, but=_C.CRASHED | _C.TUMBLED),
        Transition(_S.LOCKED, all=_C.STOP),
    ),
}
CAN_FLY = frozenset((_S.READY, _S.FLYING, _S.LEVEL_OUT, _S.LANDED))
STAYS_ARMED = CAN_FLY | {_S.ARMING}
FOLLOWS = frozenset((_S.ARMING, _S.READY, _S.LANDED, _S.FLYING))  # the set-point is the commander's


@dataclass(frozen=True, slots=True)
class Seen:
    """What the supervisor looks at: `turning`: a motor is over its idle thrust; the specific force is in g, B."""

    tick: int
    setpoint: Setpoint
    turning: bool
    acceleration: Vector


class Supervisor:
    """`state`, `armed` and the bits of its last look may be read."""

    def __init__(self) -> None:
        self.state = State.NOT_INITIALIZED
        self.armed = False
        self.bits = 0
        self.stop_wanted = False  # the emergency stop, by a client
        self.crashed = self.tumbled = False
        self._fed_tick = self._turning_tick = self._tilted_tick = 0  # 0: not yet
        self._ready_tick = self._landed_tick = 0

    @property
    def can_fly(self) -> bool:
        return self.state in CAN_FLY

    @property
    def can_arm(self) -> bool:
        return self.state is State.CHECKS_PASSED

    @property
    def locked(self) -> bool:
        return self.state is State.LOCKED

    @property
    def flying(self) -> bool:
        return self.state in (State.FLYING, State.LEVEL_OUT)

    def request_arming(self, armed: bool) -> bool:
        """Arm or disarm; False when the request to arm was refused."""
        if armed and not self.armed and not self.can_arm:
            return False
        self.armed = armed
        return True

    def request_recovery(self) -> bool:
        """Forget a crash; False while the robot lies on its side."""
        if self.crashed and self.tumbled:
            return False
        self.crashed = False
        return True

    def feed_watchdog(self, tick: int) -> None:
        """Start the watchdog of the emergency stop, or hold it off for another second."""
        self._fed_tick = tick

    def update(self, seen: Seen, commander_bits: int) -> None:
        """Change the state; `commander_bits` are those of the high-level commander."""
        now = self._conditions(seen)
        before = self.state
        for transition in TRANSITIONS[before]:
            if transition.applies(now):
                self._enter(transition.to, seen.tick)
                break
        self.tumbled = bool(now & Condition.TUMBLED)
        flags = (
            self.can_arm, self.armed, True, self.can_fly, self.flying, self.tumbled, self.locked, self.crashed,
        )  # fmt: skip
        self.bits = commander_bits | sum(1 << bit for bit, flag in enumerate(flags) if flag)

    def override(self, setpoint: Setpoint) -> Setpoint:
        """Return the set-point that the state allows."""
        if self.state in FOLLOWS:
            return setpoint
        return Setpoint(other=True) if self.state is State.LEVEL_OUT else NULL

    def _enter(self, state: State, tick: int) -> None:
        self.state = state
        if state is State.READY:
            self._ready_tick = tick
        if state is State.LANDED:
            self._landed_tick = tick
        if state is State.CRASHED:
            self.crashed = True
        if state not in STAYS_ARMED:
            self.armed = state is State.CHECKS_PASSED  # by itself

    def _conditions(self, seen: Seen) -> Condition:
        tick = seen.tick
        if seen.turning:
            self._turning_tick = tick
        flies = self._turning_tick and tick - self._turning_tick < FLYING_MS
        age_ms = tick - seen.setpoint.tick
        hungry = self._fed_tick and tick >= self._fed_tick + WATCHDOG_MS
        stays = self.state is State.READY and tick - self._ready_tick > PREFLIGHT_MS
        landed = self._landed_tick and tick - self._landed_tick > LANDED_MS
        flags = (
            self.armed, flies, self._is_tumbled(seen), age_ms > LEVEL_OUT_MS, age_ms > LOCK_MS,
            self.stop_wanted or hungry, self.crashed, stays, landed,
        )  # fmt: skip
        return Condition(sum(1 << bit for bit, flag in enumerate(flags) if flag))

    def _is_tumbled(self, seen: Seen) -> bool:
        """Return whether the robot has been tilted, or upside down, for too long; a free fall does not count."""
        if all(abs(part) < FREE_FALL_G for part in seen.acceleration):
            self._tilted_tick = 0
        z = seen.acceleration[2]
        if z >= TILT_G:
            self._tilted_tick = 0
            return False
        self._tilted_tick = self._tilted_tick or seen.tick
        tilted_ms = seen.tick - self._tilted_tick
        return tilted_ms > TILT_MS or (z < UPSIDE_DOWN_G and tilted_ms > UPSIDE_DOWN_MS)
