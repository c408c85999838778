import gymnasium as gym
import pytest

from agents.task import Task
from predictor.support.errors import UserError
from tests.agents.helpers import TOY

TAG = "simple_tag_v3"


@pytest.fixture
def without_envpool(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.task.importlib.util.find_spec", lambda name: None)


@pytest.mark.parametrize(
    ("env_id", "settings", "message"),
    [
        ("merge-generic-v1", {"backend": "envpool"}, "EnvPool has no copy of 'merge-generic-v1'; it has highway-v0, "),
        ("nonsense", {"backend": "envpool"}, "EnvPool has no copy of 'nonsense'"),
        (TAG, {"backend": "envpool"}, f"backend envpool has no {TAG}; leave it out"),
        ("highway-fast-v0", {"learners": ("adversary",)}, "highway-fast-v0 has one ego; leave them out"),
        (TAG, {"driver": "fast"}, "driver must be one of random, idle, varied, heuristic, mixed, got 'fast'"),
        (TAG, {"observe": "none", "checkpoint": "highway"}, "has no effect with observe=none"),
        (TAG, {"device": "tpu9"}, "device must be cpu, cuda or auto, got 'tpu9'"),
    ],
)
def test_what_does_not_go_together_is_named(env_id: str, settings: dict, message: str):
    with pytest.raises(UserError, match=message) as error:
        Task(env_id, **settings)
    assert "\n" not in str(error.value)


def test_a_missing_envpool_is_named(without_envpool: None):
    with pytest.raises(UserError, match=r"needs the envpool package; pip install 'dgvae-rl\[envpool\]'"):
        Task("highway-fast-v0", backend="envpool")


def test_a_missing_envpool_does_not_matter_to_other_backends(without_envpool: None):
    assert Task("highway-fast-v0").backend == "gymnasium"


def test_one_ego_or_many_learners():
    assert Task(TAG).is_multiagent
    assert Task(TOY).is_multiagent
    assert not Task("highway-fast-v0").is_multiagent


def test_what_the_wrappers_get():
    assert Task(TAG, "constant-velocity").forecaster == "constant-velocity"
    assert Task(TAG, checkpoint="somewhere").forecaster == "somewhere"
    assert Task(TAG).forecaster is None


def test_the_check_gives_the_action_space_of_the_learners():
    assert Task(TAG, "constant-velocity", learners=("adversary",)).check() == gym.spaces.Discrete(5)
    speaker, listener = (Task("simple_speaker_listener_v4", "none", learners=(name,)) for name in ("speaker_0", "all"))
    assert speaker.check() == gym.spaces.Discrete(3)
    with pytest.raises(UserError, match="learners: 'all' is neither an agent nor a role"):
        listener.check()


def test_the_check_finds_drivers_that_cannot_drive():
    assert Task(TOY, "none").check() == gym.spaces.Discrete(2)  # all agents learn
    assert Task(TOY, "none", learners=("ant",), driver="varied").check() == gym.spaces.Discrete(2)
    with pytest.raises(UserError, match="no heuristic drives meadow_v0"):
        Task(TOY, "none", learners=("ant",)).check()


def test_the_check_needs_a_reader_for_forecasts():
    with pytest.raises(UserError, match="no scene reader knows meadow_v0"):
        Task(TOY, "constant-velocity").check()
