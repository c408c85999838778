"""Absurd sizes on the command line are refused by an estimate, in one sentence, before anything is allocated."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents.evaluate import EvaluateConfig as EvaluatePolicyConfig
from agents.study import StudyConfig
from envs.collect import CollectConfig
from envs.evaluate import EvaluateConfig as EvaluateEnvConfig
from predictor.data.nri import NRIConfig
from predictor.data.springs import SpringsConfig
from predictor.data.store import read_store
from predictor.data.windows import Windows
from predictor.dgvae.config import DGVAEConfig
from predictor.evaluate import EvaluateConfig
from predictor.suite import SuiteConfig
from predictor.support.errors import UserError
from predictor.support.memory import check_count, check_memory, memory_bytes
from predictor.training.batches import check_batch, open_batches
from predictor.training.config import TrainConfig
from tests.predictor.helpers import write_circles
from train_policy import TrainPolicyConfig

OUT = Path("never-made")
ABSURD: list[tuple[Callable[[], Any], str]] = [
    (lambda: TrainConfig((OUT,), OUT, batch_size=10**11), "batch_size=100,000,000,000"),
    (lambda: TrainConfig((OUT,), OUT, horizon_steps=10**11), "--horizon-steps"),
    (lambda: CollectConfig("highway-v0", OUT, workers=10**6, episodes=10**6), "workers=1,000,000"),
    (lambda: CollectConfig("highway-v0", OUT, episodes=10**12), "episodes=1,000,000,000,000"),
    (lambda: EvaluateEnvConfig(("highway-v0",), episodes=10**12), "episodes=1,000,000,000,000"),
    (lambda: EvaluateEnvConfig(("highway-v0",), num_samples=10**12), "num_samples=1,000,000,000,000"),
    (lambda: EvaluateEnvConfig(("highway-v0",), episodes=10**6, workers=10**6), "workers=1,000,000"),
    (lambda: EvaluatePolicyConfig(Path("run"), episodes=10**6, num_envs=10**6), "num_envs=1,000,000"),
    (lambda: EvaluatePolicyConfig(Path("run"), episodes=10**12), "episodes=1,000,000,000,000"),
    (lambda: StudyConfig("quick", workers=10**6), "workers=1,000,000"),
    (lambda: SuiteConfig("springs", OUT, workers=10**6), "workers=1,000,000"),
    (lambda: EvaluateConfig(str(OUT), OUT, num_samples=10**12), "num_samples=1,000,000,000,000"),
    (lambda: EvaluateConfig(str(OUT), OUT, horizon_steps=10**12), "horizon_steps times num_samples"),
    (lambda: SpringsConfig(OUT, train=10**12), "train=1,000,000,000,000"),
    (lambda: NRIConfig(OUT, train=10**12), "train="),
    (lambda: TrainPolicyConfig(num_envs=10**6), "num_envs=1,000,000"),
    (lambda: TrainPolicyConfig(eval_episodes=10**12), "eval_episodes=1,000,000,000,000"),
    (lambda: DGVAEConfig(hidden_dim=10**11), "hidden_dim must be at most 65,536"),
]


@pytest.mark.skipif(memory_bytes() is None, reason="this system does not tell its memory")
@pytest.mark.parametrize(("make", "message"), ABSURD, ids=[message for _, message in ABSURD])
def test_absurd_sizes_are_refused(make: Callable[[], Any], message: str):
    with pytest.raises(UserError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def test_usual_sizes_pass():
    CollectConfig("highway-v0", OUT, workers=8, episodes=100_000)
    TrainConfig((OUT,), OUT, batch_size=4096)
    TrainPolicyConfig(num_envs=16)
    NRIConfig(OUT)


def test_the_limit_is_what_there_is():
    check_memory(2**30, "a store", "make it smaller", available_bytes=2**30)
    with pytest.raises(UserError, match=r"^a store needs at least 2.0 GiB, and there are 1.0 GiB; make it smaller$"):
        check_memory(2**31, "a store", "make it smaller", available_bytes=2**30)


def test_all_options_that_are_multiplied_are_named():
    with pytest.raises(UserError, match=r"pass a smaller --horizon-steps or --num-samples$"):
        check_count(10**16, "horizon_steps times num_samples")


def test_a_batch_is_estimated_before_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """States of 10⁸ windows alone would fit into 16 GiB; with the agents and pairs of the data they do not."""
    monkeypatch.setattr("predictor.support.memory.memory_bytes", lambda: 2**34)
    store = read_store(write_circles(tmp_path / "data"))
    config = TrainConfig((tmp_path / "data",), tmp_path / "run", batch_size=10**8)
    windows = Windows(store.episodes, store.info.spec, config.history_steps, config.horizon_steps)
    with pytest.raises(UserError, match=r"^a step with batch_size=100,000,000 needs at least .*pass a smaller --batch"):
        open_batches(config, [windows], torch.device("cpu"), DGVAEConfig())
    open_batches(dataclasses.replace(config, batch_size=64), [windows], torch.device("cpu"), DGVAEConfig())


def test_a_batch_counts_states_and_pairs(monkeypatch: pytest.MonkeyPatch):
    """Windows of 10 agents and 5 steps ahead: 960 bytes of states, and 4 · 24 bytes for each of 100 pairs."""
    given: list[int] = []
    monkeypatch.setattr("predictor.training.batches.check_memory", lambda needed, *_: given.append(needed))
    config, network = TrainConfig((OUT,), OUT, batch_size=8), DGVAEConfig(rnn_dim=24)
    few = dataclasses.replace(network, num_neighbours=3)
    for sizes in (network, few, None):
        check_batch(config, np.full(7, 10), sizes, torch.device("cpu"))
    assert given == [8 * (960 + 96 * 100), 8 * (960 + 96 * 30), 8 * 960]
