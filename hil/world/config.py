"""The robot as it really is in this world: body, tether, limits, servos. Every default names its source.

"paper" is the Floaty paper, "assumed" has no source; docs/explanation/plant.md explains the consequences.
"""

from __future__ import annotations

from math import pi, radians
from typing import Annotated, Literal

from pydantic import Field, model_validator

from firmware_py.section import Section, number
from hil.world.servos import WORDS_PER_RADIAN

Positive = Annotated[float, Field(gt=0)]
Extent = Annotated[float, Field(ge=0, le=2)]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]
Factor = Annotated[float, Field(ge=0.25, le=4)]
Variant = Literal["plate", "methods", "table", "methods_open", "table_open"]
ConstantName = Literal[
    "roll_u1", "roll_roll", "roll_rate", "y_u1", "y_roll",
    "pitch_u2", "pitch_pitch", "pitch_rate", "x_u2", "x_pitch",
    "yaw_u3", "yaw_rate", "z_u4",
]  # fmt: skip


class TetherConfig(Section):
    """The safety line from an anchor above: slack in flight, a spring and damper that only pulls when taut."""

    anchor_height: float = number(1.5, "(0, 5]", "above the hover point [m]; chosen (paper: over pulleys)")
    length: float = number(2.3, "(0, 8]", "to the base plate [m]; catches 0.87 m below hover; chosen")
    stiffness: float = number(100.0, "(0, 2000]", "[N/m]; chosen: 3 cm under the weight")
    damping: float = number(5.0, "[0, 50]", "[N s/m]; chosen: about critical with the counter-weight")


class NetConfig(Section):
    """The net over the tunnel's exit and the robot's four feet on it; the paper names neither: all chosen."""

    height: float = number(0.0, "[-2, 2]", "z of the net in W [m]; the tunnel's exit; chosen")
    foot_spread: float = number(0.06, "(0, 0.3]", "|x|, |y| of a foot [m]; beyond the base plate; chosen")
    foot_below: float = number(0.05, "(0, 0.3]", "below the centre of mass [m]; under the batteries; chosen")
    stiffness: float = number(800.0, "(0, 5000]", "under one foot [N/m]; chosen: 1 mm under the weight")
    damping: float = number(8.0, "[0, 50]", "under one foot [N s/m]; chosen: half of critical")
    friction: float = number(0.5, "[0, 2]", "coefficient [1]; chosen")


class LimitsConfig(Section):
    """Where a flight counts as lost."""

    radius: float = number(0.45, "(0, 0.6]", "from the tunnel's axis [m]; half the flow is left")
    below: float = number(0.8, "(0, 1.2]", "below the hover point [m]; assumed: recoveries flown from 0.65")
    above: float = number(0.85, "(0, 5]", "above the hover point [m]; paper: cameras see 2 m over the tunnel")
    tilt: float = number(pi / 2, f"(0, {pi})", "of the body's z from the vertical [rad]; chosen")


class MassConfig(Section):
    """A box of even density; `place` is that of its centre from the point above B where the flap axes meet."""

    mass: float = Field(gt=0, le=5, description="[kg]")
    place: Three = Field((0.0, 0.0, 0.0), description="x, y, z in B from where the flap axes meet [m]")
    size: tuple[Extent, Extent, Extent] = Field((0.0, 0.0, 0.0), description="along x, y, z of B [m]")
    mirrored: bool = Field(False, description="four of them, at (+-x, +-y)")


class GeometryConfig(Section):
    """The robot's shape and masses: that of docs/explanation/plant.md. Statements about a
    flap hold for flap 2, in the quadrant (+,+) of B, at flap angle 0; the other three are its mirror images.

    Mass and centre of mass follow from `flap_mass` and `masses`, the moments of inertia too where none are given.
    """

    footprint: float = number(0.23, "(0.02, 2]", "side of the square of four quadrants [m]; paper")
    base_side: float = number(0.08, "(0, 1]", "side of the base plate [m]; original firmware, baseArea")
    outline: Annotated[tuple[tuple[float, float], ...], Field(max_length=12)] = Field(
        (),
        description="corners of the unfolded flap in turn, a convex trapezoid or the like [m]; "
        "without: its quadrant of the footprint less the base plate; paper, Setup specifications",
    )
    strip_width: float = number(0.0198, "(0, 0.5]", "kinked edge [m]; tuned to the Table's roll stiffness")
    kink_angle: float = number(radians(42.5), f"[0, {pi / 2}]", "upward bend of the strip [rad]; paper")
    kink_side: Literal["x", "y"] = Field("y", description="edge with the strip: the outward one in y or in x")
    axis_azimuth: float = number(radians(45), f"[0, {pi / 2}]", "of a flap's axis [rad]; original firmware")
    dihedral: float = number(0.0, "[-1.2, 1.2]", "outward rise of flaps and axes [rad]; paper: horizontal")
    flow_point: float = number(0.0627, "(0, 0.5]", "|x| = |y| where a flap's flow is taken [m]; assumed")
    flap_mass: float = number(0.025, "(0, 2]", "of each, evenly spread [kg]; paper, Setup specifications")
    masses: tuple[MassConfig, ...] = Field(
        (MassConfig(mass=0.240, place=(0.0, 0.0, -0.0991666667), size=(0.0636, 0.0636, 0.0809)),),
        description="all the rest; paper: 0.340 kg, centre of mass 7 cm below the flaps; size: from the budget of masses",
    )
    inertia: tuple[Positive, Positive, Positive] | Literal["masses"] = Field(
        (1.30e-3, 1.30e-3, 1.47e-3),
        description="about x, y, z of B [kg m2]; tuned to the paper's roll and yaw; 'masses': computed from "
        "them (1.40e-3, 1.40e-3, 1.15e-3)",
    )


class PlantConfig(Section):
    """The geometry's plates in the flow, corrected to a set of identified constants (docs/explanation/plant.md, Correction).

    The drag coefficient is not a free constant: it is trimmed so that the robot hovers at `airspeed` and `hover_angle`
    (of G0 C_D = 1.353 at 1.225 kg/m3). Model errors are the factors, true over design: they act after the trim.
    """

    variant: Variant = Field(
        "methods",
        description="plate: isolated plates; else their linearisation is corrected to the paper's Table",
    )
    airspeed: float = number(10.0, "(1, 60]", "of the design hover [m/s]; paper, Setup specifications")
    hover_angle: float = number(radians(25), "(-0.5, 1.2]", "flap angle in the design hover [rad]; paper")
    mass_factor: Factor = Field(1.0, description="true mass over design mass")
    inertia_factor: Factor = Field(1.0, description="true inertia over design inertia")
    drag_factor: Factor = Field(1.0, description="true force and torque of the flow over the design's")
    constant_factors: dict[ConstantName, Annotated[float, Field(ge=0, le=4)]] = Field(
        {}, description="true over tabulated value of single constants of a corrected variant"
    )
    tether: TetherConfig = Field(default_factory=TetherConfig)
    ground: NetConfig = Field(default_factory=NetConfig)
    limits: LimitsConfig = Field(default_factory=LimitsConfig)

    @model_validator(mode="after")
    def _factors_act(self) -> PlantConfig:
        if self.variant == "plate" and self.constant_factors:
            raise ValueError("constant_factors act only on corrected variants, not on 'plate'")
        return self


class PlantServoConfig(Section):
    """The four servos of the world, as the board was trimmed for them."""

    zero_offset: Four = Field(
        (
            -3600 / WORDS_PER_RADIAN,
            -5000 / WORDS_PER_RADIAN,
            -9000 / WORDS_PER_RADIAN,
            6200 / WORDS_PER_RADIAN,
        ),
        description="pulse of a level flap, from the middle pulse of 1.5 ms [rad]; original firmware, motorShifts",
    )
    tau: float = number(0.050, "(0.001, 0.5]", "first-order lag [s]; original firmware: flapTimeConst 20 1/s")
    rate_limit: float = number(10.5, "(0, 100]", "[rad/s]; assumed: 0.1 s for 60 deg")
    dead_band: float = number(radians(0.1), "[0, 0.1]", "error that does not move it [rad]; assumed")
    trim_error: Four = Field((0.0, 0.0, 0.0, 0.0), description="flap angle minus the intended one [rad]")
    speed: tuple[Annotated[float, Field(ge=0, le=4)], ...] = Field(
        (1.0, 1.0, 1.0, 1.0),
        min_length=4,
        max_length=4,
        description="factor on the servo's pace: 1 healthy, 0 stuck",
    )


class TunnelConfig(Section):
    """The flow of one flight; where no source is named it is a choice (docs/explanation/plant.md, Tunnel)."""

    speed: float = number(10.0, "(0, 60]", "mean flow at the hover point [m/s]; paper, Setup specifications")
    profile_radius: float = number(0.45, "(0.05, 5]", "R in w(r) = speed / (1 + (r / R)^6) [m]; assumed")
    height_slope: float = number(0.05, "[0, 0.5]", "loss of speed with height [1/m]; assumed")
    hover_height: float = number(1.15, "(0, 3]", "hover point above the exit [m]; paper, Hover: 115 cm")
    turbulence: Literal["none", "T0", "T1"] = Field("T0", description="gust level; T0: the paper's hover")
    gust_scale: float = number(1.0, "[0, 5]", "factor on the gusts of that level")
    side_wind: Three = Field((0.0, 0.0, 0.0), description="added everywhere, x y z of W [m/s]")
    fan_factor: float = number(1.0, "[0, 2]", "factor on everything that the fans blow")


class BatteryConfig(Section):
    """Two small lithium polymer cells, and their loads.

    The paper gives 0.925 Wh per cell (3.7 V) and 7.6 V for both (3.8 V each). Both are true of one cell here: 3.80 V is the
    mean open-circuit voltage, and 0.925 Wh of 0.951 Wh are usable at the paper's 3.4 W.
    """

    cells: int = number(2, "[1, 6]", "in series; paper, Robot design and fabrication")
    capacity: float = number(900.0, "(1, 1e5]", "charge of a full cell [A s]; paper: 250 mAh, single cell")
    resistance: float = number(0.22, "[0, 2]", "of a cell with leads [ohm]; chosen: 0.925 Wh each at 3.4 W")
    charge: float = number(1.0, "[0, 1]", "at the start, as a share of the capacity")
    electronics_power: float = number(0.3, "[0, 50]", "board and IMU [W]; paper, Energy efficiency")
    servo_power: float = number(0.50, "[0, 10]", "of each, holding [W]; calibrated on the paper's 3.4 W")
    servo_energy: float = number(0.33, "[0, 10]", "per angle turned [J/rad]; calibrated on the paper's 3.4 W")


class SwarmConfig(Section):
    """Robots that fly together: the places of `floaty fly --robots`, and what they do to one another."""

    spacing: float = number(
        0.5, "(0, 20]", "of the V without `places`: robots behind one another, x and y [m]"
    )
    places: tuple[Three, ...] = Field(
        (),
        description="x, y, z from the profile's home, W [m], of robot 1, 2, ...; empty: a V that points along x",
    )
    distance_min: float = number(
        0.15, "[0, 10]", "limit on the least distance between two centres of mass after the release [m]"
    )
    radius: float = number(
        0.07,
        "[0, 1]",
        "of the sphere by which robots touch [m]; a 2.1+ with its propellers; 0: they never touch",
    )
    stiffness: float = number(150.0, "(0, 5000]", "of two spheres [N/m]; chosen, as that of the floor")
    damping: float = number(0.3, "[0, 50]", "of two spheres that approach each other [N s/m]; chosen")
    wake: float = number(1.0, "[0, 3]", "factor on the speed of the rotors' wakes [1]; 0: no downwash")
    wake_radius: float = number(
        0.065, "(0.005, 1]", "of the wake at the rotors [m]; chosen: the rotors' outline"
    )
    wake_spread: float = number(
        0.1,
        "[0, 1]",
        "growth of that radius per length [1]; a free turbulent jet's, Pope, Turbulent Flows, 5.1",
    )
