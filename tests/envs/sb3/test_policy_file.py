import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import pytest
import torch
from safetensors.torch import load_file, save_file
from sb3_contrib import QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3

from envs.drivers.trained import env_for_driver
from envs.registry import make_env
from envs.rollouts.own_view import own_view
from envs.rollouts.world import open_world
from envs.sb3.algorithms import Algorithm, algorithm_class
from envs.sb3.policy_file import (
    ForecasterPin,
    PolicyNote,
    algorithm_of,
    load_policy,
    pin_forecaster,
    read_note,
    read_policy_note,
    selection_return,
    write_note,
)
from envs.wrappers import ForecastObservation
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.support.errors import UserError
from tests.envs.helpers import save_forecast_policy

ENV_ID = "two-way-v0"
TINY: dict[str, Any] = {"device": "cpu", "seed": 0}
PIN = ForecasterPin("highway", "ab" * 32, 5, 1, 12, 100.0)


def saved(folder: Path, algorithm: str) -> Path:
    env, steered = gym.make("CartPole-v1"), gym.make("Pendulum-v1")
    model: Any = {
        "ppo": lambda: PPO("MlpPolicy", env, n_steps=4, batch_size=4, **TINY),
        "dqn": lambda: DQN("MlpPolicy", env, buffer_size=10, **TINY),
        "a2c": lambda: A2C("MlpPolicy", env, **TINY),
        "sac": lambda: SAC("MlpPolicy", steered, buffer_size=10, **TINY),
        "qrdqn": lambda: QRDQN("MlpPolicy", env, buffer_size=10, **TINY),
        "recurrent-ppo": lambda: RecurrentPPO("MlpLstmPolicy", env, n_steps=4, batch_size=4, **TINY),
        "tqc": lambda: TQC("MlpPolicy", steered, buffer_size=10, **TINY),
        "td3": lambda: TD3("MlpPolicy", steered, buffer_size=10, **TINY),
        "trpo": lambda: TRPO("MlpPolicy", env, n_steps=4, batch_size=4, **TINY),
        "maskable-ppo": lambda: MaskablePPO("MlpPolicy", env, n_steps=4, batch_size=4, **TINY),
        "crossq": lambda: CrossQ("MlpPolicy", steered, buffer_size=10, **TINY),
    }[algorithm]()
    model.save(folder / "policy.zip")
    return folder / "policy.zip"


def pin_of(checkpoint: str, **options: Any) -> ForecasterPin:
    env = ForecastObservation(make_env(ENV_ID), checkpoint, **options)
    space: Any = env.observation_space
    return pin_forecaster(checkpoint, space, env.get_wrapper_attr("scene_spec"))


@pytest.fixture
def retrained(tmp_path: Path, highway_checkpoint: str) -> str:
    """A checkpoint of the same name and sizes with other weights."""
    folder = tmp_path / "retrained" / Path(highway_checkpoint).name
    shutil.copytree(highway_checkpoint, folder)
    tensors = load_file(folder / "model.safetensors")
    name = next(iter(tensors))
    save_file(tensors | {name: tensors[name] + 1e-3 * torch.ones_like(tensors[name])}, folder / "model.safetensors")
    return str(folder)


# --- Note -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pin", [PIN, None], ids=["forecasts", "none"])
def test_a_note_travels_inside_the_zip(pin: ForecasterPin | None, tmp_path: Path):
    path, note = saved(tmp_path, "ppo"), PolicyNote(pin, ("adversary",), "varied")
    write_note(path, note, {"steps": 3})
    assert read_policy_note(path) == note
    assert read_note(path) == {"steps": 3}
    assert isinstance(load_policy(path), PPO)


def test_a_zip_of_sb3_alone_says_nothing(tmp_path: Path):
    path = saved(tmp_path, "ppo")
    assert read_policy_note(path) is None
    assert read_note(path) == {}
    assert read_policy_note(tmp_path / "absent.zip") is None


# --- Pin --------------------------------------------------------------------------------------------------------------


def test_a_pin_holds_the_weights_and_what_the_policy_sees(highway_checkpoint: str):
    pin = pin_of(highway_checkpoint, horizon_steps=4, num_samples=3, max_agents=7, perception_m=60.0)
    assert (pin.horizon_steps, pin.num_samples, pin.max_agents, pin.perception_m) == (4, 3, 7, 60.0)
    assert pin.sha256 is not None and len(pin.sha256) == 64
    assert pin_of(CONSTANT_VELOCITY).sha256 is None


def test_a_folder_that_moved_is_the_same_forecaster(tmp_path: Path, highway_checkpoint: str):
    moved = tmp_path / "elsewhere"
    shutil.copytree(highway_checkpoint, moved)
    pin_of(highway_checkpoint).check(pin_of(str(moved)), "policy")


def test_other_weights_are_named_with_their_hashes(highway_checkpoint: str, retrained: str):
    pin, other = pin_of(highway_checkpoint), pin_of(retrained)
    assert pin.sha256 is not None and other.sha256 is not None
    expected = (
        f"policy x was trained on forecaster '{highway_checkpoint}' .SHA-256 {pin.sha256[:12]}…., but gets "
        f"'{retrained}' .SHA-256 {other.sha256[:12]}….; pass the checkpoint"
    )
    with pytest.raises(UserError, match=expected):
        pin.check(other, "policy x")


def test_constant_velocity_has_a_name_only():
    pin = replace(PIN, checkpoint=CONSTANT_VELOCITY, sha256=None)
    pin.check(pin, "policy")
    for one, other in ((pin, PIN), (PIN, pin)):
        with pytest.raises(UserError, match="was trained on forecaster"):
            one.check(other, "policy")


@pytest.mark.parametrize(
    ("field", "other"), [("horizon_steps", 7), ("num_samples", 7), ("max_agents", 7), ("perception_m", None)]
)
def test_other_options_are_named(field: str, other: int | None):
    PIN.check(PIN, "policy")
    with pytest.raises(UserError, match=f"policy was trained on forecasts with {field}=.*, but gets {field}={other};"):
        PIN.check(replace(PIN, **{field: other}), "policy")


def test_a_policy_drives_with_its_own_forecaster_only(tmp_path: Path, highway_checkpoint: str, retrained: str):
    policy = str(save_forecast_policy(tmp_path, ENV_ID, highway_checkpoint))
    assert env_for_driver(make_env(ENV_ID), policy)
    for measured in (highway_checkpoint, retrained):
        world = open_world(ENV_ID, policy, measured)
        world.reset(0)
        for env, checkpoint in ((world.env, measured), (own_view(world.env).env, highway_checkpoint)):
            expected = ForecastObservation(make_env(ENV_ID), checkpoint)
            expected.reset(seed=0)
            assert torch.equal(env.forecast.xy, expected.forecast.xy)
        world.close()


def test_a_forecaster_trained_anew_in_place_is_noticed(tmp_path: Path, highway_checkpoint: str, retrained: str):
    folder = tmp_path / "mine"
    shutil.copytree(highway_checkpoint, folder)
    policy = str(save_forecast_policy(tmp_path, ENV_ID, str(folder)))
    shutil.copy(Path(retrained) / "model.safetensors", folder)
    with pytest.raises(UserError, match="was trained on forecaster .*mine' .SHA-256 .* but gets '.*mine' .SHA-256"):
        env_for_driver(make_env(ENV_ID), policy)


# --- Loading ----------------------------------------------------------------------------------------------------------


ALGORITHMS = get_args(Algorithm)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_algorithm_is_told_by_the_content(algorithm: Algorithm, tmp_path: Path):
    path = saved(tmp_path, algorithm)
    assert algorithm_of(path) == algorithm
    assert type(load_policy(path)) is algorithm_class(algorithm)


def test_the_note_names_the_algorithm(tmp_path: Path):
    """Whatever parameters a later version of SB3 writes."""
    path = saved(tmp_path, "a2c")
    write_note(path, None, {"steps": 3}, "ppo")
    assert algorithm_of(path) == "ppo"
    assert read_note(path) == {"steps": 3}


@pytest.mark.parametrize("algorithm", ["td3", "trpo", "crossq", "maskable-ppo"])
def test_other_algorithms_are_refused(algorithm: str, tmp_path: Path):
    with pytest.raises(UserError, match=f"policy.zip holds no policy of {', '.join(ALGORITHMS)}$"):
        load_policy(saved(tmp_path, algorithm))


def test_a_policy_of_contrib_needs_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = saved(tmp_path, "qrdqn")
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(UserError, match=r"algorithm qrdqn needs the sb3-contrib package; pip install 'dgvae-rl\[con"):
        load_policy(path)
    assert load_policy(saved(tmp_path, "dqn")) is not None


def test_another_number_of_plans_is_said_by_what_changes_it():
    """No option has the name num_plans."""
    with pytest.raises(
        UserError, match="policy x was trained with 5 candidate plans .* here there are 9; give the env"
    ):
        replace(PIN, num_plans=5).check(replace(PIN, num_plans=9), "policy x")


def test_a_zip_that_is_cut_anywhere_is_damaged(tmp_path: Path):
    """Its weights are a zip of their own: cut soon after them, the file still holds a whole archive, another one."""
    path, cut = saved(tmp_path, "ppo"), tmp_path / "cut.zip"
    write_note(path, None, {"selection_return": 3.0}, "ppo")
    assert algorithm_of(path) == "ppo" and selection_return(path) == 3.0
    content, inner = path.read_bytes(), 0
    for size in range(0, len(content), max(1, len(content) // 150)):
        cut.write_bytes(content[:size])
        inner += zipfile.is_zipfile(cut)
        with pytest.raises(UserError, match="cut.zip is damaged; copy it again, or name another .zip of its run$"):
            algorithm_of(cut)
        with pytest.raises(UserError, match="cut.zip is damaged; remove it to go on without it$"):
            selection_return(cut)
    assert inner


def test_a_zip_that_lacks_its_weights_is_one_clear_line(tmp_path: Path):
    path, damaged = saved(tmp_path, "ppo"), tmp_path / "damaged.zip"
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(damaged, "w") as part:
        part.writestr("data", whole.read("data"))
    with pytest.raises(UserError, match="damaged.zip is no ppo policy that fits here: ") as error:
        load_policy(damaged)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"garbage", b"\x80\x02cabsent_module\nNet\n."])
def test_weights_that_cannot_be_unpickled_are_one_clear_line(content: bytes, tmp_path: Path):
    path, damaged = saved(tmp_path, "ppo"), tmp_path / "damaged.zip"
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(damaged, "w") as other:
        for name in whole.namelist():
            other.writestr(name, content if name == "policy.pth" else whole.read(name))
    with pytest.raises(UserError, match="damaged.zip is no ppo policy that fits here: ") as error:
        load_policy(damaged)
    assert "\n" not in str(error.value)


def test_a_policy_whose_network_is_not_installed_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def absent(*args: object, **kwargs: object) -> None:
        raise ModuleNotFoundError("No module named 'ownnet'")

    path = saved(tmp_path, "ppo")
    monkeypatch.setattr("stable_baselines3.PPO.load", absent)
    with pytest.raises(UserError, match="is no ppo policy that fits here: No module named 'ownnet'"):
        load_policy(path)
