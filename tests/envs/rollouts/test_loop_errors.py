import json

import numpy as np
import pytest
import torch

from envs.rollouts.loop_errors import LoopErrors
from predictor.scene import Forecast, SceneBatch

HORIZON, DT_S, AGENTS = 3, 0.5, 4


def scenes(rng: np.random.Generator, ids: list[list[int]]) -> SceneBatch:
    """Returns one scene for each list of identities, the ego's first, with random states."""
    filled = np.full((len(ids), AGENTS), -1)
    for row, present in zip(filled, ids, strict=True):
        row[: len(present)] = present
    states = rng.normal(scale=20.0, size=(len(ids), AGENTS, 4)) * (filled >= 0)[..., None]
    return SceneBatch(states, filled, filled >= 0, np.zeros(len(ids)))


def forecast(rng: np.random.Generator, batch: int, samples: int = 2) -> Forecast:
    shape = (batch, AGENTS)
    return Forecast(
        torch.from_numpy(rng.normal(size=(batch, samples, AGENTS, HORIZON, 2))),
        torch.ones(*shape, 1, 2),
        torch.zeros(*shape, 1, 1),
        torch.ones(shape, dtype=torch.bool),
    )


def test_errors_are_those_of_every_forecast_and_truth_of_an_episode():
    rng = np.random.default_rng(0)
    # one environment; identities change places, 12 comes late, 13 leaves and the second episode has other agents
    ids = [[9, 11, 13], [9, 13, 11], [9, 12, 11], [9, 11, 12], [5, 11, 6], [5, 6, 11], [5, 6]]
    steps = [(scenes(rng, [present]), forecast(rng, 1)) for present in ids]
    last = scenes(rng, [[9, 12]])  # the scene that closes the first episode, between steps 3 and 4
    first_episode, second_episode = [*(s for s, _ in steps[:4]), last], [s for s, _ in steps[4:]]
    errors = LoopErrors(HORIZON, DT_S)
    for i, (scene, future) in enumerate(steps):
        ended = i == 4
        errors.add(last if ended else scene, np.array([ended]), scene, future)

    expected = {"ours": [[] for _ in range(HORIZON)], "constant": [[] for _ in range(HORIZON)]}
    for episode, offset in ((first_episode, 0), (second_episode, 4)):
        for t, scene in enumerate(episode):
            if episode is first_episode and t == 4:
                continue  # nothing is forecast from a closing scene
            xy = steps[offset + t][1].xy[0, 0].numpy()
            for h in range(min(HORIZON, len(episode) - 1 - t)):
                later = episode[t + 1 + h]
                for a in range(1, AGENTS):
                    where = np.flatnonzero(later.ids[0] == scene.ids[0, a])
                    if scene.ids[0, a] < 0 or not len(where):
                        continue
                    truth = later.states[0, where[0], :2]
                    ours = scene.states[0, 0, :2] + xy[a, h]
                    constant = scene.states[0, a, :2] + scene.states[0, a, 2:4] * DT_S * (h + 1)
                    expected["ours"][h].append(np.linalg.norm(ours - truth))
                    expected["constant"][h].append(np.linalg.norm(constant - truth))
    wanted = tuple(np.mean([np.mean(values) for values in expected[row]]) for row in ("ours", "constant"))
    assert errors.errors_m() == pytest.approx(wanted)
    assert errors.errors_m() is None, "counted once"


def test_what_was_compared_outlives_a_reset_and_a_stop():
    rng = np.random.default_rng(2)
    steps = [(scenes(rng, [[1, 2, 3]]), forecast(rng, 1)) for _ in range(8)]
    first, second = steps[:4], steps[4:]
    no = np.array([False])

    def fed(errors: LoopErrors, part: list[tuple[SceneBatch, Forecast]]) -> LoopErrors:
        errors.drop_pending()
        for scene, future in part:
            errors.add(scene, no, scene, future)
        return errors

    reset = fed(fed(LoopErrors(HORIZON, DT_S), first), second)
    stopped = LoopErrors(HORIZON, DT_S)
    stopped.go_on(json.loads(json.dumps(fed(LoopErrors(HORIZON, DT_S), first).sums())))
    assert fed(stopped, second).sums() == reset.sums()
    apart = [fed(LoopErrors(HORIZON, DT_S), part).sums()["counts"] for part in (first, second)]
    assert reset.sums()["counts"] == np.sum(apart, axis=0).tolist(), "no forecast is compared across a reset"
    assert stopped.errors_m() == reset.errors_m()


def test_an_episode_that_ends_elsewhere_changes_nothing():
    rng = np.random.default_rng(1)
    here = [scenes(rng, [[1, 2, 3]]) for _ in range(5)]
    futures = [forecast(rng, 1) for _ in here]
    alone, beside = LoopErrors(HORIZON, DT_S), LoopErrors(HORIZON, DT_S)
    for i, (scene, future) in enumerate(zip(here, futures, strict=True)):
        alone.add(scene, np.array([False]), scene, future)
        empty = scenes(rng, [[7]])
        both = SceneBatch.concatenate(scene, empty)
        doubled = Forecast(
            *(torch.cat([part, part]) for part in (future.xy, future.edge_probs, future.edge_features, future.valid))
        )
        beside.add(both, np.array([False, i % 2 == 1]), both, doubled)
    assert beside.errors_m() == pytest.approx(alone.errors_m())
