"""What a campaign's file may say: the example loads, every mistake is one line with what, value and what is allowed."""

from pathlib import Path

import pytest

from hil.research.campaigns.config import find_spec, read_spec
from hil.research.campaigns.sampling import check_spec, draw
from support.campaigns import spec_of
from support.command import Cli

HOVER = 'experiments = ["hover"]\nflights = 64\n'


@pytest.mark.long
def test_the_example_flies_the_hover_on_every_robot_that_the_table_allows() -> None:
    spec = read_spec(find_spec("table"))
    check_spec(spec)
    assert (spec.flights, spec.experiments) == (1000, ("hover",))
    factors = draw(spec, 999).request().config.plant.constant_factors
    assert len(factors) == 13
    assert spec.table is not None
    assert spec.table.constants == "all"


PARAMETERS = HOVER + "[parameters]\n"
TAU = PARAMETERS + '"actuators.tau" = '
PUSH = HOVER + '[[faults]]\nkind = "push.y"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("flights = 3", "experiments: missing"),
        ("flights = [", "not TOML"),
        ('experiments = ["hover"]\nflights = 0', "flights = 0: input should be greater than or equal to 1"),
        (HOVER + "fligths = 3", "fligths = 3: unknown key; did you mean flights?"),
        (HOVER + 'sampling = "halton"', "sampling = 'halton': input should be 'random', 'sobol'"),
        (HOVER + 'stop = "soon"', "stop = 'soon': expected \"failure rate known to ±1 %\""),
        (HOVER + 'stop = "failure rate known to ±0 %"', "above 0 and below 50"),
        (HOVER + 'stop = "failure rate known to ±50 %"', "above 0 and below 50"),
        (HOVER + "seed = -1", "seed = -1"),
        (TAU + "{ unifrom = [1, 2] }", "did you mean uniform?"),
        (TAU + "{ uniform = [2, 1] }", "expected low < high"),
        (TAU + "{ uniform = [1, 1] }", "expected low < high"),
        (TAU + "{}", "expected one of uniform, log_uniform, normal, choice"),
        (TAU + "{ log_uniform = [0, 1] }", "expected bounds above 0"),
        (TAU + "{ normal = [0.05, 0] }", "expected a deviation above 0"),
        (TAU + "{ choice = [] }", "parameters.actuators.tau.choice"),
        (TAU + "{ uniform = [0.0001, 0.05] }", "actuators.tau = 0.00014"),
        (TAU + "{ uniform = [0.04, 0.9] }", "actuators.tau = 0.8"),
        (PARAMETERS + '"serial.baud" = { uniform = [100000, 200000] }', "input should be a valid integer"),
        (PARAMETERS + '"actuators.tua" = { uniform = [0.04, 0.06] }', "did you mean tau?"),
        (
            PARAMETERS + '"plant.variant" = { choice = ["methods", "bent", "plate"] }',
            "plant.variant = 'bent'",
        ),
        (HOVER + '[table]\nconstants = ["roll_u9"]', "table.constants.0 = 'roll_u9': input should be"),
        ('experiments = "hover"\nflights = 3', "experiments = 'hover': input should be a valid list"),
        (PUSH + "start_s = { uniform = [1.0] }", "faults.0.start_s.uniform.1: missing"),
        (
            HOVER + '[table]\n[parameters]\n"plant.constant_factors.roll_u1" = { uniform = [1, 2] }',
            "in both [parameters] and [table]",
        ),
        (HOVER + '[[faults]]\nkind = "push.w"\nstart_s = 1', "fault 'push.w@1.0': unknown kind 'push.w'"),
        (PUSH + "start_s = 1\nsize = 99", "size 99: expected -20..20 N"),
        (PUSH + "start_s = 99", "the flight ends 30 s after the release"),
        (PUSH + "start_s = 1\nprobability = 2", "faults.0.probability = 2"),
        (HOVER + "[limits]\nwall_s = 0", "limits.wall_s = 0: input should be greater than 0"),
        (HOVER + 'sampling = "saltelli"', "needs at least two numbers that vary; there are 0"),
        (HOVER + 'sampling = "saltelli"\n[table]', "with 13 numbers that vary needs 60 or 120"),
        (HOVER + 'sampling = "morris"\n[table]', "with 13 numbers that vary needs 56 or 70"),
        (
            HOVER + 'sampling = "morris"\nstop = "failure rate known to ±1 %"\n[table]',
            "needs all its flights",
        ),
        (HOVER.replace("hover", "hovver"), "experiment 'hovver': unknown; did you mean hover?"),
        (PUSH.replace('"]', '", "yaw-step"]') + "start_s = 20", "push.y@20=2: the flight ends 5 s after"),
        (HOVER + 'profiles = ["flaoty"]', "did you mean floaty?"),
        (
            HOVER + 'profiles = ["floaty", "crazyflie"]',
            "profile crazyflie: its robot flies with the Crazyflie's",
        ),
        (HOVER + 'board = "cf2.elf"', "cf2.elf: no such file; expected c, python"),
    ],
)
def test_a_bad_spec_is_one_line_and_exit_code_two(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.toml").write_text(text, encoding="utf-8")
    assert message in cli.refusal("campaign", "bad.toml")
    assert list(tmp_path.iterdir()) == [tmp_path / "bad.toml"], "nothing was begun"


def test_files_that_a_spec_names_begin_at_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(
        'experiments = ["mine.py:PUSHED", "hover"]\nprofiles = ["lab.toml"]\nboard = "cf2.elf"\nflights = 1\n'
    )
    spec = read_spec(path)
    assert spec.experiments == (f"{tmp_path}/mine.py:PUSHED", "hover")
    assert spec.profiles == (f"{tmp_path}/lab.toml",)
    assert spec.board == f"{tmp_path}/cf2.elf"


@pytest.mark.parametrize(("flights", "points"), [(11, 2), (12, 2), (13, 3)])
def test_the_last_point_of_a_campaign_may_have_fewer_flights(flights: int, points: int) -> None:
    """Of two experiments on three profiles."""
    spec = spec_of(flights=flights, experiments=("hover", "y-square"), profiles=("floaty", "as-flown", "lqr"))
    assert (spec.cells, spec.points) == (6, points)
