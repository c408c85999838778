import numpy as np
import pytest

from envs.readers import FunctionReader
from envs.registry import make_env
from envs.rollouts.interventions import intervene, interventions_of, kinds_of
from envs.rollouts.world import EgoWorld, open_world
from envs.simulators.interventions import KINDS, Intervention
from envs.wrappers import SceneObservation
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError


@pytest.mark.parametrize("checkpoint", [None, "constant-velocity"])
def test_an_agent_is_found_by_the_id_that_is_reported(checkpoint: str | None):
    world = open_world("highway-fast-v0", "idle", checkpoint)
    world.reset(0)
    assert kinds_of(world) == KINDS
    for _ in range(2):
        world.step()
    scene = world.full_scene()
    agent = int(scene.ids[4])
    intervene(world, Intervention(agent, "brake", 1, change_mps=5.0))
    assert list(interventions_of(world)) == [agent]
    world.step()
    assert interventions_of(world) == {}
    slower = np.hypot(*world.full_scene().states[:, 2:].T) - np.hypot(*scene.states[:, 2:].T)
    assert slower.argmin() == 4
    assert slower[4] == pytest.approx(-5.0)


def test_a_reader_without_bodies_says_what_is_missing():
    def read(env: object) -> Scene:
        return Scene(np.zeros((1, 4)), np.zeros(1, dtype=np.int64), np.ones(1, dtype=np.bool_))

    env = SceneObservation(make_env("highway-fast-v0"), reader=FunctionReader(read, SceneSpec(dt_s=1.0)))
    with pytest.raises(UserError, match="cannot find an agent by its id, .* body_of"):
        kinds_of(EgoWorld(env, "idle"))
