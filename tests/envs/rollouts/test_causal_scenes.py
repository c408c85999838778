from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.rollouts import causal_scenes, side_forecasts
from envs.rollouts.causal_labels import IN_ARENAS, ON_ROADS, causal_labels
from envs.rollouts.causal_scenes import GraphTask, labelled_scene, play_graph
from envs.rollouts.cause_run import EVERY, FIRST_STEP
from envs.rollouts.side_forecasts import SideForecaster
from envs.seeding import Purpose, episode_rng
from predictor.scene import Forecast, Scene
from tests.envs.evaluation import TAG, forget, save_tag
from tests.envs.interventions import assert_same_scenes, played, road_world


@pytest.fixture(autouse=True)
def nothing_is_kept() -> Iterator[None]:
    forget()
    yield
    forget()


class ByIds(SideForecaster):
    """Its probability of an edge is a number made of the ids of receiver and sender."""

    def __init__(self) -> None:
        self.scene: Any = None

    def observe(self, scene: Scene) -> None:
        self.scene = scene

    def forecast(self) -> Forecast:
        ids = torch.from_numpy(self.scene.ids).float()
        prob = (10 * ids[:, None] + ids) / 100
        edges = torch.stack([1 - prob, prob], dim=-1)[None]
        valid = torch.from_numpy(self.scene.valid)[None]
        return Forecast(torch.zeros(1, 1, len(ids), 1, 2), edges, edges[..., :1], valid)


@pytest.mark.slow
def test_pairs_stand_beside_their_own_probability_distance_and_leader():
    """Three in a row, ids 1 to 3 from the rear, one beside them (4), and the ego (0) which is no receiver."""
    world = road_world((0.0, 4.0), (25.0, 4.0), (50.0, 4.0), (20.0, 12.0), ego_m=(-30.0, 12.0))
    world.step()
    forecaster = ByIds()
    forecaster.observe(world.perceived())
    labels = causal_labels(world, ON_ROADS)
    untouched = world.full_scene()
    found = labelled_scene(world, {"ids": forecaster}, ON_ROADS)
    assert_same_scenes([world.full_scene()], [untouched])
    senders = np.round(100 * found.edge_prob["ids"]).astype(int) % 10
    receivers = np.round(100 * found.edge_prob["ids"]).astype(int) // 10
    np.testing.assert_array_equal(receivers, found.receiver)
    ids = list(labels.ids)
    places = {int(i): state[:2] for i, state in zip(untouched.ids, untouched.states, strict=True)}
    columns = zip(receivers, senders, found.shift_m, found.distance_m, found.geometry, strict=True)
    for receiver, sender, shift_m, distance_m, geometry in columns:
        assert shift_m == labels.shift_m[ids.index(receiver), ids.index(sender)]
        np.testing.assert_array_equal(geometry[:2], places[sender] - places[receiver])
        assert distance_m == pytest.approx(np.linalg.norm(places[receiver] - places[sender]))
    assert set(zip(receivers, senders, strict=True)) == {(r, s) for r in (1, 2, 3, 4) for s in range(5) if r != s}
    assert found.leads is not None
    assert {(r, s) for r, s, leads in zip(receivers, senders, found.leads, strict=True) if leads} == {(1, 2), (2, 3)}
    assert found.shift_m[found.leads].min() > 1.0 > found.shift_m[~found.leads].max()
    to_ego = found.to_ego
    assert to_ego is not None and to_ego.leads is not None and to_ego.to_ego is None
    tried = np.round(100 * to_ego.edge_prob["ids"]).astype(int)  # receiver 0, the ego
    assert set(tried) == {1, 2, 3, 4} and set(to_ego.receiver) == {0}
    assert to_ego.leads.tolist() == (tried == 4).tolist()  # on its lane is agent 4 alone
    np.testing.assert_array_equal(to_ego.shift_m, [labels.shift_m[0, ids.index(agent)] for agent in tried])
    expected = [np.linalg.norm(places[agent] - places[0]) for agent in tried]
    np.testing.assert_allclose(to_ego.distance_m, expected, rtol=1e-5)


@pytest.mark.slow
def test_nobody_is_ahead_of_an_ego_that_leads():
    world = road_world((0.0, 12.0), (15.0, 4.0), (30.0, 4.0), ego_m=(25.0, 12.0))
    forecaster = ByIds()
    forecaster.observe(world.perceived())
    found = labelled_scene(world, {"ids": forecaster}, ON_ROADS)
    assert found.to_ego is not None and found.to_ego.leads is not None
    assert len(found.to_ego.leads) and not found.to_ego.leads.any()


def test_who_is_not_perceived_is_left_out():
    """The one in front is 120 m away from the ego, which perceives 100 m."""
    world = road_world((70.0, 4.0), (90.0, 4.0), (120.0, 4.0), ego_m=(0.0, 12.0))
    world.env._scene = world.reread()[0]  # type: ignore[union-attr]
    forecaster = ByIds()
    forecaster.observe(world.perceived())
    found = labelled_scene(world, {"ids": forecaster}, ON_ROADS)
    assert set(found.receiver) == {1, 2}


def task(checkpoint: str, **changes: Any) -> GraphTask:
    settings: dict[str, Any] = {"seed": 900_000, "max_steps": 12, "settings": IN_ARENAS} | changes
    return GraphTask(env_id=TAG, driver="heuristic", checkpoints=(checkpoint,), **settings)


def test_an_episode_has_labels_at_every_fifth_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    steps: list[int] = []
    measure = causal_scenes.labelled_scene

    def note(world: Any, *arguments: Any) -> Any:
        steps.append(world.env.unwrapped.steps if hasattr(world.env.unwrapped, "steps") else -1)
        return measure(world, *arguments)

    monkeypatch.setattr(causal_scenes, "labelled_scene", note)
    quick = replace(IN_ARENAS, horizon_s=0.3, senders=2)
    found = play_graph(task(save_tag(tmp_path / "tag"), settings=quick))
    first = int(episode_rng(900_000, Purpose.LABELS).integers(EVERY))
    expected = [step for step in range(first, 12, EVERY) if step >= FIRST_STEP]
    assert steps == expected and len(found) == len(expected) > 0
    for scene in found:
        assert scene.leads is None and set(scene.receiver) <= {0, 1, 2, 3}  # landmarks are left out
        assert scene.to_ego is None
        assert set(scene.edge_prob) == {"tag"} and ((scene.edge_prob["tag"] >= 0) & (scene.edge_prob["tag"] <= 1)).all()
        assert np.ptp(scene.edge_prob["tag"]) > 0


@pytest.mark.slow
def test_an_episode_is_a_function_of_its_seed_and_goes_on_as_ever(tmp_path: Path):
    checkpoint = save_tag(tmp_path / "tag")
    first, second, other = (
        play_graph(task(checkpoint, seed=seed, max_steps=9)) for seed in (900_001, 900_001, 900_002)
    )
    assert len(first) == len(second)
    for one, two in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.shift_m, two.shift_m)
        np.testing.assert_array_equal(one.edge_prob["tag"], two.edge_prob["tag"])
    assert not np.array_equal(first[0].distance_m, other[0].distance_m)


@pytest.mark.slow
def test_labels_of_one_step_do_not_change_the_next():
    world, untouched = (road_world((0.0, 4.0), (25.0, 4.0), ego_m=(0.0, 12.0)) for _ in range(2))
    world.step(), untouched.step()
    labelled_scene(world, {}, ON_ROADS)
    assert_same_scenes(played(world, 4), played(untouched, 4))


@pytest.mark.unchecked
def test_a_policy_that_sees_forecasts_perceives_what_the_first_learned_checkpoint_does(monkeypatch: pytest.MonkeyPatch):
    opened: list[str] = []
    monkeypatch.setattr(side_forecasts, "sees_forecasts", lambda driver: True)
    monkeypatch.setattr(side_forecasts, "open_world", lambda env_id, driver, seen, **_: opened.append(seen))
    for checkpoints in (("constant-velocity", "mine"), ("mine", "yours"), ("constant-velocity",)):
        side_forecasts.open_for_checkpoints("highway-fast-v0", "policy.zip", checkpoints)
    assert opened == ["mine", "mine", "constant-velocity"]
