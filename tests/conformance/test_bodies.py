"""What every body keeps, also one of the user's own: held it feels its weight, it is pushed, draws power, can be drawn."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.config import LabConfig, load_config
from hil.laboratory.bodies import BODIES, make_body
from hil.world.body import Body
from hil.world.in_tunnel import TunnelBody
from hil.world.scene import VisualModel
from support.paths import ROOT

PROFILES = ("crazyflie", "crazyflie-brushless", "floaty")
OWN = ROOT / "hil" / "commands" / "robot_project"
G = 9.81


@pytest.fixture(scope="module", params=[*PROFILES, OWN])
def config(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> LabConfig:
    if request.param in PROFILES:
        return load_config(request.param)
    tmp_path = tmp_path_factory.mktemp("own")
    for name in ("controller.py", "profile.toml", "robot.py"):
        (tmp_path / name).write_text((OWN / f"{name}.in").read_text(encoding="utf-8"), encoding="utf-8")
    return load_config(str(tmp_path / "profile.toml"))


@pytest.fixture
def body(config: LabConfig) -> Body:
    home, offset = config.flight.home, config.flight.start_offset
    place = tuple(np.add(home, offset).tolist())
    made = make_body(config, np.random.default_rng(1), place)
    made.draw(0, 3.9)
    made.hold()
    return made


def test_every_body_that_ships_is_tried() -> None:
    assert {load_config(profile).robot.body for profile in PROFILES} == set(BODIES)


@pytest.mark.long
def test_held_it_stays_and_feels_its_weight(body: Body) -> None:
    before = body.state.tobytes()
    body.advance(100_000)
    assert body.state.tobytes() == before
    assert body.specific_force_B == pytest.approx([0.0, 0.0, G], abs=1e-9)
    assert body.lost is None


@pytest.mark.long
def test_views_keep_their_memory_and_cannot_be_written(body: Body) -> None:
    views = (body.state, body.p_WB, body.q_WB, body.omega_B, body.specific_force_B, body.flow_W, body.pushes)
    places = [view.ctypes.data for view in views]
    body.release()
    body.advance(50_000)
    again = (body.state, body.p_WB, body.q_WB, body.omega_B, body.specific_force_B, body.flow_W, body.pushes)
    assert [view.ctypes.data for view in again] == places
    assert not any(view.flags.writeable for view in views)
    assert body.state[:3] == pytest.approx(body.p_WB)
    assert body.state[6:10] == pytest.approx(body.q_WB)
    assert body.state[10:] == pytest.approx(body.omega_B)


def test_a_push_moves_it_and_being_put_back_ends_that(body: Body, config: LabConfig) -> None:
    body.release()
    body.push((0.0, 1.0, 0.0))
    assert body.pushes.tolist() == [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    body.advance(50_000)
    assert body.p_WB[1] > 1e-4
    body.put_back(config.flight.home)
    assert body.p_WB.tolist() == list(config.flight.home)
    assert body.lost is None


def test_it_is_lost_outside_its_limits_by_the_first_cause_and_flies_again_when_it_is_put_back(
    body: Body, config: LabConfig
) -> None:
    for turn in range(2):
        body.release()
        body.push((30.0, 0.0, 60.0))
        at_us = 5_000_000 * turn
        while body.lost is None:
            at_us += 10_000
            body.advance(at_us)
            assert at_us < 5_000_000 * turn + 3_000_000
        first = body.lost
        body.push((0.0, -90.0, -90.0))
        body.advance(at_us + 500_000)
        assert body.lost == first
        body.push((0.0, 0.0, 0.0))
        body.put_back(config.flight.home)
        assert body.lost is None


def test_each_foot_stands_on_the_floor_however_it_is_tilted(body: Body) -> None:
    assert isinstance(body, TunnelBody)
    memory = body._body
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        foot = np.array((x * memory.foot_spread, y * memory.foot_spread, -memory.foot_below))
        turn, _ = Rotation.align_vectors([[0.0, 0.0, -1.0]], [foot])
        for above in (-1e-4, 1e-4):
            height = body.room.floor + float(np.linalg.norm(foot)) + above
            body.place((0.0, 0.0, height), tuple(turn.as_quat(scalar_first=True)))
            assert (memory.ground[2] > 0.0) == (above < 0.0)


def test_it_draws_at_least_what_its_electronics_do(body: Body, config: LabConfig) -> None:
    body.advance(10_000)
    assert body.draw(10_000, 3.9) >= config.battery.electronics_power


def test_it_names_an_output_per_count_and_logs_as_many_values_as_columns(body: Body) -> None:
    body.set_counts(1_000, [0] * len(body.outputs))
    for channel in body.channels():
        columns = sum(len(quantity.names) for quantity in channel.quantities)
        assert np.size(channel.read()) == columns


def test_it_can_be_drawn_and_seen(body: Body) -> None:
    assert body.look.parts
    assert all(part.triangles.shape[1:] == (3, 3) for part in body.look.parts)
    assert body.markers.places.shape == (8, 3)
    assert VisualModel.read(body.look.stored()).stored() == body.look.stored()


def test_the_same_instant_has_the_same_bits_however_the_time_to_it_is_divided(config: LabConfig) -> None:
    ends = []
    for instants in ([60_000], [1, 999, 1_000, 12_345, 60_000]):
        made = make_body(config, np.random.default_rng(1), config.flight.home)
        for now_us in instants:
            made.advance(now_us)
        ends.append(made.state.tobytes())
    assert ends[0] == ends[1]


def test_every_setting_can_be_turned_there_and_back(body: Body) -> None:
    for name, setting in body.settings.items():
        before = setting.read()
        setting.write(0.5)
        assert setting.read() == pytest.approx(0.5), name
        setting.write(before)
        assert setting.read() == before
