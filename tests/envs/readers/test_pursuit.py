from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from mpe2.simple_tag_v3 import parallel_env as tag_env
from pettingzoo import ParallelEnv
from pettingzoo.sisl.pursuit.pursuit import parallel_env
from pettingzoo.sisl.pursuit.utils.discrete_agent import DiscreteAgent
from pettingzoo.utils import BaseParallelWrapper

from envs.readers.base import MultiagentReader, MultiagentScene
from envs.readers.pursuit import PursuitReader, is_pursuit_env
from predictor.support.errors import ProtocolError, UserError

LEFT, RIGHT, UP, DOWN, STAY = range(5)
STEPS = {LEFT: (-1, 0), RIGHT: (1, 0), UP: (0, 1), DOWN: (0, -1), STAY: (0, 0)}


def grid_of(env: ParallelEnv) -> Any:
    return env.unwrapped.env


def placed(pursuers: list[tuple[int, int]], evaders: list[tuple[int, int]], **kwargs: Any) -> ParallelEnv:
    """Bodies in exactly these cells; evaders do not move and are caught by two pursuers in their cell."""
    env = parallel_env(
        n_pursuers=len(pursuers), n_evaders=len(evaders), freeze_evaders=True, surround=False, n_catch=2, **kwargs
    )
    env.reset(seed=0)
    for layer, cells in ((grid_of(env).pursuer_layer, pursuers), (grid_of(env).evader_layer, evaders)):
        for i, cell in enumerate(cells):
            layer.set_position(i, *cell)
    return env


def step(env: ParallelEnv, *actions: int) -> None:
    env.step(dict(zip(env.agents, actions or [STAY] * len(env.agents), strict=True)))


def by_id(multi: MultiagentScene) -> dict[int, list[float]]:
    scene = multi.scene
    return {int(i): s.tolist() for i, s in zip(scene.ids[scene.valid], scene.states[scene.valid], strict=True)}


def test_scene_is_what_stands_on_the_grid():
    env = placed([(0, 0), (3, 2)], [(15, 15), (1, 12), (2, 2)])
    reader = PursuitReader(env)
    assert isinstance(reader, MultiagentReader)
    multi = reader.read(env)
    multi.scene.check("pursuit", reader.spec, agents=5)
    expected = [[0, 0, 0, 0, 0], [3, 2, 0, 0, 0], [15, 15, 0, 0, 1], [1, 12, 0, 0, 1], [2, 2, 0, 0, 1]]
    assert multi.scene.states.tolist() == expected
    assert multi.scene.ids.tolist() == [0, 1, 2, 3, 4]
    assert multi.index_of == {"pursuer_0": 0, "pursuer_1": 1}
    assert not multi.heading_rad.any()


def test_spec_describes_the_grid():
    spec = PursuitReader(parallel_env(x_size=12, y_size=9, n_pursuers=3, n_evaders=4)).spec
    assert (spec.dt_s, spec.has_ego, spec.frame, spec.max_agents) == (1.0, False, ("world", "world"), 7)
    assert spec.perception_m == 15.0
    assert spec.constant_features == ("evader",)
    chosen = PursuitReader(parallel_env(), max_agents=50, perception_m=3.5).spec
    assert (chosen.max_agents, chosen.perception_m) == (50, 3.5)


@pytest.mark.parametrize("action", STEPS)
def test_velocity_is_the_last_step(action: int):
    env = placed([(5, 2), (10, 2)], [(0, 15)])
    reader = PursuitReader(env)
    assert not reader.read(env).scene.states[:, 2:4].any()
    step(env, action, STAY)
    states = reader.read(env).scene.states
    assert states[0].tolist() == [5 + STEPS[action][0], 2 + STEPS[action][1], *STEPS[action], 0]
    assert states[1].tolist() == [10, 2, 0, 0, 0]


def test_who_runs_into_a_wall_stands():
    env = placed([(0, 0), (5, 4)], [(0, 15)])  # the border to the left, the building above
    reader = PursuitReader(env)
    reader.read(env)
    step(env, LEFT, UP)
    assert reader.read(env).scene.states[:2].tolist() == [[0, 0, 0, 0, 0], [5, 4, 0, 0, 0]]


def test_reading_twice_at_a_step_keeps_the_velocity():
    env = placed([(5, 2), (10, 2)], [(0, 15)])
    reader = PursuitReader(env)
    reader.read(env)
    step(env, RIGHT, DOWN)
    first, second = reader.read(env), reader.read(env)
    np.testing.assert_array_equal(first.scene.states, second.scene.states)
    assert first.scene.states[0, 2:4].tolist() == [1, 0]
    step(env, STAY, STAY)
    assert not reader.read(env).scene.states[:, 2:4].any()


def test_velocity_is_the_mean_over_steps_that_were_not_read():
    env = placed([(5, 2), (10, 2)], [(0, 15)])
    reader = PursuitReader(env)
    reader.read(env)
    for action in (RIGHT, RIGHT, UP, STAY):
        step(env, action, STAY)
    assert reader.read(env).scene.states[0].tolist() == [7, 3, 0.5, 0.25, 0]


def test_an_evader_keeps_its_id_when_one_before_it_is_caught():
    env = placed([(4, 2), (6, 2)], [(5, 2), (9, 3), (12, 12)])
    reader = PursuitReader(env)
    before = by_id(reader.read(env))
    step(env, RIGHT, LEFT)
    after = by_id(reader.read(env))
    assert set(before) - set(after) == {2}
    assert after[3] == [9, 3, 0, 0, 1]
    assert after[4] == [12, 12, 0, 0, 1]


def test_two_are_caught_at_the_same_step_and_the_rest_move_on():
    cells = [(1, 1), (5, 2), (9, 3), (12, 2), (14, 14)]
    env = placed([(5, 1), (5, 3), (12, 1), (12, 3)], cells)
    reader = PursuitReader(env)
    bodies = list(grid_of(env).evader_layer.allies)
    numbers = reader.read(env).scene.ids[4:].tolist()
    for survivor in (0, 2, 4):
        bodies[survivor].set_position(cells[survivor][0], cells[survivor][1] - 1)
    step(env, UP, DOWN, UP, DOWN)
    after = by_id(reader.read(env))
    assert [i for i in numbers if i in after] == [numbers[0], numbers[2], numbers[4]]
    for survivor in (0, 2, 4):
        x, y = cells[survivor]
        assert after[numbers[survivor]] == [x, y - 1, 0, -1, 1]


def test_one_comes_as_another_is_caught():
    env = placed([(4, 2), (6, 2)], [(5, 2), (9, 3)])
    reader = PursuitReader(env)
    reader.read(env)
    grid = grid_of(env)
    step(env, RIGHT, LEFT)
    newcomer = DiscreteAgent(16, 16, grid.map_matrix, grid.np_random)
    newcomer.set_position(5, 2)
    grid.evader_layer.allies.insert(0, newcomer)
    grid.evader_layer.nagents += 1
    after = by_id(reader.read(env))
    assert after[4] == [5, 2, 0, 0, 1]  # a new number, and no velocity of the one that stood there
    assert after[3] == [9, 3, 0, 0, 1]
    assert 2 not in after


def test_the_last_scene_has_indices_of_all_agents():
    env = placed([(4, 2), (6, 2)], [(5, 2)])
    reader = PursuitReader(env)
    reader.read(env)
    observations, _, terminations, _, _ = env.step({"pursuer_0": RIGHT, "pursuer_1": LEFT})
    assert all(terminations.values())
    assert env.agents == []
    multi = reader.read(env)
    assert multi.index_of == {"pursuer_0": 0, "pursuer_1": 1}
    assert set(multi.index_of) == set(observations)
    assert multi.scene.valid.tolist() == [True, True, False]


def test_an_agent_that_dies_in_an_episode_has_no_index_but_its_body_stays():
    env = placed([(4, 2), (6, 2)], [(9, 9)])
    env.unwrapped.agents = ["pursuer_1"]
    multi = PursuitReader(env).read(env)
    assert multi.index_of == {"pursuer_1": 1}
    assert multi.scene.valid.all()


def test_a_whole_episode_keeps_identities_and_velocities():
    """Against a plain loop that keeps the simulator's own objects."""
    env = parallel_env(max_cycles=120, n_catch=1, surround=False)
    reader = PursuitReader(env)
    env.reset(seed=4)
    rng = np.random.default_rng(4)
    number_of: dict[Any, int] = {}
    last: dict[Any, np.ndarray] = {}
    caught = 0
    while env.agents:
        multi = reader.read(env)
        bodies = [*grid_of(env).pursuer_layer.allies, *grid_of(env).evader_layer.allies]
        assert multi.scene.valid.sum() == len(bodies)
        for index, body in enumerate(bodies):
            position = np.array(body.current_position(), dtype=np.float64)
            velocity = position - last.get(body, position)
            assert number_of.setdefault(body, int(multi.scene.ids[index])) == multi.scene.ids[index]
            np.testing.assert_array_equal(multi.scene.states[index, :4], [*position, *velocity])
            last[body] = position
        step(env, *rng.integers(5, size=len(env.agents)).tolist())
        caught = 38 - len(bodies)
    assert len(set(number_of.values())) == len(number_of) == 38
    assert caught >= 5


def test_a_new_episode_has_new_bodies_and_numbering_restarts_at_reset():
    env = placed([(4, 2), (6, 2)], [(9, 9)])
    reader = PursuitReader(env)
    assert reader.read(env).scene.ids.tolist() == [0, 1, 2]
    env.reset(seed=1)
    scene = reader.read(env).scene
    assert scene.ids.tolist() == [3, 4, 5]
    assert not scene.states[:, 2:4].any()
    reader.reset()
    assert reader.read(env).scene.ids.tolist() == [0, 1, 2]


def test_wrapped_environments_read_alike():
    env = placed([(4, 2), (6, 2)], [(9, 9)])
    wrapped = BaseParallelWrapper(env)
    assert by_id(PursuitReader(wrapped).read(wrapped)) == by_id(PursuitReader(env).read(env))


def test_reading_before_the_first_reset_is_a_protocol_error():
    env = parallel_env()
    with pytest.raises(ProtocolError, match="no agents yet; call reset"):
        PursuitReader(env).read(env)


def test_too_small_max_agents_are_named():
    env = placed([(4, 2), (6, 2)], [(9, 9)])
    with pytest.raises(UserError, match="PursuitReader: 3 agents do not fit max_agents=2 of the reader's spec"):
        PursuitReader(env, max_agents=2).read(env)


def test_other_families_are_named():
    assert is_pursuit_env(parallel_env())
    assert not is_pursuit_env(tag_env())
    assert not is_pursuit_env(gym.make("CartPole-v1"))
    with pytest.raises(UserError, match="PursuitReader needs PettingZoo's pursuit, got raw_env"):
        PursuitReader(tag_env())
