"""The benchmark of joint futures: errors of known samples, and which agents count."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import joint_futures
from benchmarks.envpool_parity import untouched_drivers
from benchmarks.joint_futures import Errors, displacements_of, errors_of
from predictor.evaluation.outcomes import Outcome
from predictor.support.errors import UserError


def test_errors_of_samples_that_belong_together():
    # Sample 1 is right about both agents of the first scene, and about one agent each in the second.
    scenes = [np.array([[1.0, 3.0], [0.0, 0.0], [9.0, 9.0]]), np.array([[4.0, 4.0], [0.0, 8.0], [8.0, 0.0]])]
    found = errors_of([*scenes, np.zeros((3, 1))], 2, np.random.default_rng(0))
    assert found is not None
    assert (found.agents, found.scenes, found.single, found.best, found.joint) == (2, 2, 3.0, 0.0, 2.0)
    # Mixed samples find the pairs of the second scene by chance, and lose that of the first.
    assert found.joint != found.mixed > 0


def test_of_one_agent_mixing_changes_nothing_and_the_nearest_is_first():
    found = errors_of([np.array([[2.0, 7.0], [1.0, 0.0]])], 1, np.random.default_rng(0))
    assert found == Errors(1, 1, 2.0, 1.0, 1.0, 1.0)
    assert found.cells() == ("1", "1", "2.000", "1.000 (50 %)", "1.000 (50 %)", "1.000 (50 %)")
    assert errors_of([np.zeros((2, 1))], 2, np.random.default_rng(0)) is None


def test_mixing_costs_samples_that_move_all_agents_alike_and_nothing_else():
    rng = np.random.default_rng(0)
    alike = [np.repeat(rng.uniform(size=(20, 1)), 5, axis=1) for _ in range(50)]
    independent = [rng.uniform(size=(20, 5)) for _ in range(50)]
    together, apart = errors_of(alike, 5, rng), errors_of(independent, 5, rng)
    assert together is not None and apart is not None
    assert together.joint == pytest.approx(together.best) and together.mixed > 3 * together.joint
    assert apart.mixed == pytest.approx(apart.joint, rel=0.05)


def test_agents_count_whose_whole_future_is_known():
    future = torch.zeros(2, 3, 4, 2)
    forecast = torch.zeros(2, 5, 3, 4, 2)
    forecast[0, :, 2, :, 0] = torch.arange(5.0)[:, None]
    valid = torch.ones(2, 3, 4, dtype=torch.bool)
    valid[0, 1, 3] = False
    valid[1] = False
    (scene,) = displacements_of(Outcome(forecast, future, valid))
    np.testing.assert_allclose(scene, np.stack([np.zeros(5), np.arange(5.0)], axis=1))


@pytest.mark.slow
def test_command_plays_the_deployed_wrapper(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch):
    arguments = "--env-ids merge-v1 --episodes 1 --num-samples 3 --agents 1 2 --out".split()
    monkeypatch.setattr("sys.argv", ["joint_futures", *arguments, str(tmp_path / "joint.json")])
    joint_futures.main()
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| merge-v1")]
    one, two = json.loads((tmp_path / "joint.json").read_text())["errors"]["merge-v1"]
    assert len(lines) == 2 and (one["agents"], two["agents"]) == (1, 2)
    assert one["joint"] == one["best"] == one["mixed"] <= one["single"]
    assert two["best"] <= two["joint"] <= two["single"]


def test_an_unknown_id_is_said_before_another_is_played(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["joint_futures", "--env-ids", "merge-v1", "nonsense-v0"])
    monkeypatch.setattr(joint_futures, "measure", lambda *_: pytest.fail("played"))
    with pytest.raises(UserError, match="no checkpoint ships for env 'nonsense-v0'"):
        joint_futures.main()


@pytest.mark.slow
def test_an_environment_does_not_change_the_drivers_of_the_next():
    """The crossing of highway-env gives all drivers of its process other distances and decelerations."""
    config = joint_futures.JointConfig(episodes=1, num_samples=2, agents=(1,))
    before = joint_futures.measure("merge-v1", config)
    with untouched_drivers():
        joint_futures.measure("intersection-v2", config)
        assert before and joint_futures.measure("merge-v1", config) == before
