import pytest

from envs.registry import make_env, make_multiagent_env
from envs.simulators.interventions import KINDS, Intervention, drop_all, generator_of, in_force, kinds_for, start
from predictor.support.errors import UserError


@pytest.mark.parametrize(
    ("env_id", "kinds"),
    [("highway-fast-v0", KINDS), ("roundabout-mixed-v0", KINDS)],
)
def test_roads_allow_every_kind(env_id: str, kinds: tuple[str, ...]):
    env = make_env(env_id)
    assert kinds_for(env) == kinds
    env.reset(seed=0)
    assert in_force(env) == {}
    assert generator_of(env) is env.unwrapped.np_random
    drop_all(env)


def test_the_multiagent_intersection_allows_every_kind():
    assert kinds_for(make_multiagent_env("intersection-multi-agent-v2")) == KINDS


def test_a_family_that_cannot_be_perturbed_says_so():
    grid = make_multiagent_env("pursuit_v5")
    assert in_force(grid) == {}
    with pytest.raises(UserError, match=r"^.* cannot be perturbed; use an environment of highway-env, of this project"):
        start(grid, object(), Intervention(0, "brake", 1))


def test_envpool_says_why_it_cannot_be_perturbed():
    pytest.importorskip("envpool")
    with pytest.raises(UserError, match="EnvPoolEnv cannot be perturbed: EnvPool's C\\+\\+ simulator has no access"):
        kinds_for(make_env("envpool/HighwayFast-v0"))
