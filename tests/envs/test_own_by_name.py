"""A forecaster of a user's own by its name, where a checkpoint's name is expected: measured, and behind a policy."""

from pathlib import Path

import pytest

from agents.studies.cells import _content_of
from agents.task import Task
from agents.vec_envs import make_venv
from envs.evaluate import EvaluateConfig, evaluate_env
from envs.rollouts.episode import EpisodeTask, play
from envs.rollouts.side_forecasts import fitting_checkpoints
from envs.rollouts.summary import summarise_episodes
from envs.sb3.policy_file import ForecasterPin
from envs.wrappers import ForecastObservation
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.envs.dict_crowd import DictCrowd
from tests.envs.testing.test_check_reader import SPEC
from tests.predictor.test_own_forecasters import NAME

ENV_ID = "tests.envs.dict_crowd:DictCrowd-v0"
OWN = f"{NAME}Mine"


def test_it_is_measured_beside_constant_velocity():
    episodes = [play(EpisodeTask(ENV_ID, OWN, "random", seed, 2, 3, 8)) for seed in range(2)]
    result = summarise_episodes(ENV_ID, OWN, "random", SPEC, episodes, (), None)
    assert result.checkpoint == "tests.predictor.test_own_forecasters:Mine"
    assert result.model.agents > 0
    assert result.model.min_ade_m == pytest.approx(result.constant_velocity.min_ade_m)  # it is one


def test_one_that_does_not_fit_is_named_before_anything_is_played(tmp_path: Path):
    with pytest.raises(UserError, match="coarse' was trained at dt_s=2 but env"):
        evaluate_env(EvaluateConfig((ENV_ID,), driver="random", episodes=1), ENV_ID, f"{NAME}coarse")


def test_checkpoints_and_own_ones_are_measured_together():
    assert fitting_checkpoints(ENV_ID, (OWN, "constant-velocity"), SPEC)[0] == (OWN, "constant-velocity")


def test_wrappers_and_policies_take_the_name():
    env = ForecastObservation(DictCrowd(), OWN)
    assert type(env.forecaster).__name__ == "Mine"
    task = Task(ENV_ID, "forecast", OWN)
    pin = task.note.forecaster
    assert pin is not None and (pin.checkpoint, pin.sha256) == (OWN, None)
    with pytest.raises(UserError, match=f"was trained on forecaster '{OWN}', but gets 'constant-velocity'"):
        other = Task(ENV_ID, "constant-velocity").note.forecaster
        assert other is not None
        pin.check(other, "policy a.zip")
    venv = make_venv(task, 1)
    assert venv.reset()["valid"].any()  # type: ignore[call-overload, union-attr]
    venv.close()


def test_cells_of_a_study_are_named_after_it():
    pins = [ForecasterPin(name, digest, 3, 1, 5, None) for name, digest in ((OWN, None), ("runs/a", "ab12"))]
    found = [_content_of(vars(pin)) for pin in pins]
    assert [one and one["checkpoint"] for one in found] == [OWN, None]
    assert _content_of({"sha256": "ab12"}) == {"sha256": "ab12", "checkpoint": None}
    assert _content_of(None) is None


def test_the_spec_of_the_scenes_arrives():
    spec = ForecastObservation(DictCrowd(), f"{NAME}noisy").forecaster.spec
    assert isinstance(spec, SceneSpec) and spec.dt_s == SPEC.dt_s
