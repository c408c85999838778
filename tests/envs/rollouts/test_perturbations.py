from collections import Counter

import numpy as np
import pytest

from envs.rollouts import perturbations
from envs.rollouts.interventions import interventions_of
from envs.rollouts.perturbations import ON_ROADS, SHARES, Perturber, check_kinds
from envs.rollouts.world import open_world
from envs.seeding import Purpose, driver_rng, episode_rng
from envs.simulators.intervention import Intervention, NotAllowedError
from envs.supervision import EnvironmentFailedError
from predictor.support.errors import UserError
from tests.envs.interventions import assert_same_scenes, played


@pytest.mark.slow
def test_a_share_of_the_steps_is_perturbed_and_every_kind_comes():
    world = open_world("simple_spread_v3", "idle")
    busy, kinds = [], Counter[str]()
    for seed in range(20):
        world.reset(seed)
        perturber = Perturber(world, 0.5, (), episode_rng(seed, Purpose.PERTURBATIONS))
        for _ in range(25):
            perturber()
            now = interventions_of(world)
            assert len(now) <= 1
            busy.append(len(now))
            kinds.update(one.kind for one in now.values())
            world.step()
    assert 0.4 < np.mean(busy) < 0.6
    assert set(kinds) == {"brake", "accelerate", "remove"}


def test_always_and_only_one_kind():
    world = open_world("highway-fast-v0", "idle")
    world.reset(0)
    perturber = Perturber(world, 1.0, ("brake",), episode_rng(0, Purpose.PERTURBATIONS))
    for _ in range(4):
        perturber()
        (one,) = interventions_of(world).values()
        assert one.kind == "brake" and one.change_mps is not None
        assert ON_ROADS.brake_mps[0] <= one.change_mps <= ON_ROADS.brake_mps[1]
        assert one.agent in world.perceived().ids
        world.step()


@pytest.mark.slow
def test_none_repeats_what_has_just_ended():
    """The marks of a recording could not tell the two apart, and windows would hold a beginning in their future."""
    world, begun = open_world("simple_push_v3", "idle"), 0
    for seed in range(6):
        world.reset(seed)
        perturber = Perturber(world, 1.0, (), episode_rng(seed, Purpose.PERTURBATIONS))
        before = None
        for _ in range(40):
            perturber()
            now = next(iter(interventions_of(world).values()), None)
            if now is not None and now is not before:
                begun += 1
                assert before is None or (now.agent, now.kind) != (before.agent, before.kind)
            before = now
            world.step()
    assert begun > 20


def test_interventions_follow_from_the_seed_alone():
    found = []
    for _ in range(2):
        world = open_world("simple_tag_v3", "heuristic")
        world.reset(3)
        perturber = Perturber(world, 0.7, (), episode_rng(3, Purpose.PERTURBATIONS))
        scenes = []
        for _ in range(10):
            perturber()
            scenes += played(world, 1)
        found.append(scenes)
    assert_same_scenes(found[0], found[1])


def test_streams_are_independent():
    streams = [episode_rng(5, purpose) for purpose in Purpose]
    streams += [driver_rng(5), driver_rng(5, 1), np.random.default_rng(5)]
    assert len({tuple(rng.random(4).tolist()) for rng in streams}) == 3 + len(Purpose)
    first = [episode_rng(seed, Purpose.PERTURBATIONS).random() for seed in (5, 5, 6)]
    assert first[0] == first[1] != first[2]


@pytest.mark.parametrize("error", [NotAllowedError("a landmark"), EnvironmentFailedError("raised"), UserError("other")])
def test_agents_alone_that_do_not_allow_it_are_passed_over(error: UserError, monkeypatch: pytest.MonkeyPatch):
    world = open_world("simple_tag_v3", "idle")
    world.reset(0)

    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(perturbations, "intervene", fails)
    perturber = Perturber(world, 1.0, (), episode_rng(0, Purpose.PERTURBATIONS))
    if isinstance(error, NotAllowedError):
        return perturber()
    with pytest.raises(type(error), match=str(error)):
        perturber()


def test_kinds_that_are_not_possible_are_named():
    world = open_world("simple_tag_v3", "idle")
    assert check_kinds(world, ("brake",)) == ("brake",)
    with pytest.raises(UserError, match="perturb_kinds must be among brake, accelerate, remove in this environment"):
        check_kinds(world, ("left",))


def test_kinds_come_in_their_shares(monkeypatch: pytest.MonkeyPatch):
    begun: list[Intervention] = []
    monkeypatch.setattr("envs.rollouts.perturbations.intervene", lambda world, one: begun.append(one))
    world = open_world("highway-fast-v0", "idle")
    world.reset(0)
    perturber = Perturber(world, 1.0, (), episode_rng(0, Purpose.PERTURBATIONS))
    for _ in range(1000):  # nothing acts, so that each call begins one
        perturber()
    counts = Counter(one.kind for one in begun)
    assert {kind: counts[kind] / 1000 for kind in SHARES} == pytest.approx(SHARES, abs=0.05)
