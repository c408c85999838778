"""The guide and its examples run: every Python block, every command, the environment and its reader."""

import ast
import importlib
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_seed_test
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

import dgvae_rl
import envs.readers
from envs.check import CheckConfig
from envs.collect import CollectConfig, collect
from envs.drivers.planner import Planner
from envs.evaluate import EvaluateConfig
from envs.plans import checked_plans
from envs.readers import reader_for
from envs.readers.entities import EntityRowsReader
from envs.rollouts.world import EgoWorld, open_world
from envs.testing import check_reader
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.data.store import StoreInfo, write_store
from predictor.scene import SceneSpec
from predictor.support.command_line import parse
from predictor.support.errors import UserError
from predictor.train import train
from predictor.training.config import TrainConfig
from train_policy import TrainPolicyConfig

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "docs" / "wrap_your_env.md"
EXAMPLES = ROOT / "docs" / "examples"
CROSSING = "crossing_reader:Crossing-v0"
CIRCLE = "circle_reader:Circle-v0"
COMMANDS = {
    "-m envs.collect": CollectConfig,
    "-m predictor.train": TrainConfig,
    "-m envs.evaluate": EvaluateConfig,
    "train_policy.py": TrainPolicyConfig,
    "-m envs.check": CheckConfig,
}


@pytest.fixture(autouse=True)
def examples_on_the_path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Puts the examples on the path like `export PYTHONPATH=docs/examples`; removes their registrations afterwards."""
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setattr(envs.readers, "_REGISTERED", {})
    yield
    for env_id in ("Crossing-v0", "Circle-v0"):
        gym.registry.pop(env_id, None)
    for path in EXAMPLES.glob("*.py"):
        sys.modules.pop(path.stem, None)


def sections() -> dict[str, str]:
    parts = re.split(r"^## (.+)$", GUIDE.read_text(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


WITH_PYTHON = [title for title, text in sections().items() if blocks(text, "python")]


# SB3's make_vec_env asks every environment for pictures first; the crossing draws none.
@pytest.mark.filterwarnings("ignore:.*render_mode='rgb_array' that is not in the possible render_modes:UserWarning")
@pytest.mark.parametrize("title", WITH_PYTHON)
def test_the_guides_python_runs(title: str):
    namespace: dict[str, Any] = {"__name__": "guide"}
    for block in blocks(sections()[title], "python"):
        exec(compile(block, f"{GUIDE.name}, {title}", "exec"), namespace)
    env = namespace["env"]
    if isinstance(env, gym.Env):
        obs, _ = env.reset(seed=0)
        assert obs in env.observation_space
        assert obs["valid"].any()


def test_the_guide_has_python_where_it_says():
    assert set(sections()) - set(WITH_PYTHON) == {
        "rl-baselines3-zoo",
        "Collect, train, wrap",
        "Install a reader with your package",
        "Spaces and rewards",
        "What a reader must return",
    }
    assert sum(len(blocks(text, "python")) for text in sections().values()) == GUIDE.read_text().count("```python")


def commands() -> list[str]:
    return [line for text in sections().values() for block in blocks(text, "bash") for line in block.splitlines()]


@pytest.mark.parametrize("line", commands())
def test_the_guides_commands_are_understood(line: str):
    (name,) = [name for name in COMMANDS if line.startswith(f"python {name} ")]
    parse(COMMANDS[name], args=shlex.split(line.removeprefix(f"python {name} ")))


WORKED = [
    line
    for block in blocks((ROOT / "docs" / "worked_examples.md").read_text(), "bash")
    for line in block.splitlines()
    if line.startswith("python ") and ("circle" in line or "train_policy" not in line)  # others import their packages
]


@pytest.mark.parametrize("line", WORKED)
def test_the_commands_of_the_worked_examples_are_understood(line: str):
    (name,) = [name for name in COMMANDS if line.startswith(f"python {name} ")]
    parse(COMMANDS[name], args=shlex.split(line.removeprefix(f"python {name} ")))


def test_every_command_is_in_the_guide():
    assert list(dict.fromkeys(next(name for name in COMMANDS if name in line) for line in commands())) == list(COMMANDS)


def make_crossing() -> gym.Env:
    return gym.make(CROSSING)


# --- The example environment ------------------------------------------------------------------------------------------


def test_the_crossing_is_an_environment():
    check_env(make_crossing().unwrapped, skip_render_check=True)


@pytest.mark.filterwarnings(
    "ignore:Your observation .*has an unconventional shape:UserWarning"
)  # a table, not an image
def test_the_crossing_is_one_for_sb3():
    check_env_for_sb3(make_crossing())


def test_walkers_enter_leave_and_make_way():
    env = make_crossing()
    env.reset(seed=0)
    world = env.unwrapped
    present: list[set[int]] = []
    turns = 0.0
    for _ in range(60):
        _, _, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
        present.append(set(world.numbers.tolist()))
        turns = max(turns, float(np.abs(world.walkers[:, 3]).max()))
    assert truncated and not terminated
    all_ids = set.union(*present)
    assert all_ids - present[0]
    assert all_ids - present[-1]
    assert turns > 0.3  # they wish to walk straight along x


def test_the_reader_of_the_crossing_is_short():
    assert len((EXAMPLES / "crossing_reader.py").read_text().splitlines()) <= 20
    source = (EXAMPLES / "crossing_env.py").read_text()
    assert len(source.splitlines()) <= 80
    imported = re.findall(r"^(?:from|import) (\w+)", source, flags=re.MULTILINE)
    assert set(imported) == {"typing", "gymnasium", "numpy"}  # nothing of this project


def test_the_table_tells_what_the_world_knows():
    """The example is read in both ways: asked by its reader, and recognised from its observation alone."""
    env = SceneObservation(make_crossing())
    spec = SceneSpec(dt_s=0.25, perception_m=100.0)
    table = EntityRowsReader(("presence", "x", "y", "vx", "vy"), spec, relative=True, gate_m=0.5)(env.env)
    obs, _ = env.reset(seed=1)
    number_of: dict[int, int] = {}
    before: dict[int, int] = {}
    for _ in range(30):
        table.see(obs["observation"])
        scene, truth = table.read_all(env), env.reader.read_all(env)
        places = np.linalg.norm(scene.states[:, None] - truth.states, axis=-1).argmin(axis=1)
        np.testing.assert_allclose(scene.states, truth.states[places], atol=1e-5)
        now = dict(zip(truth.ids[places].tolist(), scene.ids.tolist(), strict=True))
        for agent, number in now.items():
            assert before.get(agent, number) == number
            assert number_of.setdefault(number, agent) == agent
        before = now
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    assert len(number_of) > 8


def test_collect_train_wrap(tmp_path: Path):
    """Runs the commands' own functions on a few episodes, with a tiny network."""
    config = CollectConfig(CROSSING, tmp_path / "data", episodes=3, driver=("random",), max_steps=12, workers=1)
    episodes = list(collect(config))
    spec = reader_for(make_crossing()).spec
    write_store(config.out, StoreInfo(spec, CROSSING), episodes)
    assert all(episode.states.shape[2] == 4 and len(episode.ids) > 6 for episode in episodes)
    sizes = ("hidden_dim=4", "rnn_dim=4", "head_dim=4", "message_dim=4", "decoder_dim=4", "edge_feature_dim=2")
    checkpoint = train(
        TrainConfig(
            (config.out,),
            tmp_path / "run",
            set=sizes,
            steps=2,
            batch_size=2,
            history_steps=3,
            horizon_steps=3,
            val_fraction=0.4,
            val_windows=4,
            eval_every=2,
        )  # fmt: skip
    )
    env = ForecastObservation(make_crossing(), str(checkpoint))
    obs, _ = env.reset(seed=0)
    for _ in range(3):
        assert obs in env.observation_space
        assert obs["forecast"].shape == (11, 3, 2)
        obs, *_ = env.step(env.action_space.sample())


# --- The worked example of a crowd ------------------------------------------------------------------------------------


def test_the_circle_is_an_environment_with_a_reader_that_is_right():
    check_env(gym.make(CIRCLE).unwrapped, skip_render_check=True)
    check_reader(gym.make(CIRCLE))
    source = (EXAMPLES / "circle_env.py").read_text()
    assert set(re.findall(r"^(?:from|import) (\w+)", source, flags=re.MULTILINE)) == {"typing", "gymnasium", "numpy"}


def crossed(seed: int, action: int = 8, steps: int = 40, **kwargs: Any) -> np.ndarray:
    """The places of robot and people over the steps of an episode in which the robot takes one action."""
    env = gym.make(CIRCLE, **kwargs).unwrapped
    env.reset(seed=seed)
    found = []
    for _ in range(steps):
        env.step(action)
        found.append(np.vstack([env.robot, env.walkers])[:, :2].copy())  # type: ignore[attr-defined]
    return np.array(found)


def test_people_cross_and_keep_apart():
    for seed in range(3):
        places = crossed(seed, steps=60)[:, 1:]
        assert (np.linalg.norm(places[-1] - places[0], axis=-1) > 6.0).all()  # the circle is 10 m wide
        gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) + 9.0 * np.eye(6)
        assert gaps.min() > 0.4  # they brush past each other, and do not walk through


def test_people_make_way_for_the_robot_unless_they_do_not_see_it():
    """The only thing in the example that makes forecasts depend on the ego."""
    for seed in range(3):
        shift_m = np.abs(crossed(seed, action=2) - crossed(seed, action=8))[:, 1:].max()
        blind_m = np.abs(crossed(seed, action=2, courtesy=0.0) - crossed(seed, action=8, courtesy=0.0))[:, 1:].max()
        assert shift_m > 0.1
        assert blind_m == 0.0


def test_the_driver_of_the_circle_reaches_its_goal_or_touches_someone():
    env = open_world(CIRCLE, "own:circle_reader:straight_on")
    crashed = []
    for seed in range(20):
        env.reset(seed)
        while not env.step():
            pass
        assert isinstance(env, EgoWorld)
        crashed.append(bool(env.crashed))
    assert 0 < sum(crashed) < 20


def test_arguments_reach_the_circle():
    config = CollectConfig(CIRCLE, Path("unused"), env_kwargs='{"people": 3}', episodes=1, max_steps=5, workers=1)
    (episode,) = collect(config)
    assert len(episode.ids) == 4
    with pytest.raises(UserError, match="cannot make env .* with {'people': 0}: ValueError: people must be at least 1"):
        list(collect(replace(config, env_kwargs='{"people": 0}')))


def test_the_field_is_the_same_from_a_seed():
    from field_env import FieldEnv

    parallel_seed_test(FieldEnv)
    first, second = FieldEnv(), FieldEnv()
    for env in (first, second):
        env.reset(seed=0)
    (one, _), (other, _) = first.reset(), second.reset()
    np.testing.assert_equal(one, other)


def test_the_examples_of_other_packages_are_python():
    """They run where their packages are; here, what they import of this project is there."""
    for name in ("metadrive_reader", "vmas_reader", "magent_reader"):
        tree = ast.parse((EXAMPLES / f"{name}.py").read_text())
        ours = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module == "dgvae_rl"]
        names = {alias.name for node in ours for alias in node.names}
        assert names and names <= set(dgvae_rl.__all__)


# --- Plans of one's own -----------------------------------------------------------------------------------------------


def test_the_plan_model_of_the_example_is_short_and_the_one_of_the_page():
    text, page = (EXAMPLES / "crossing_plans.py").read_text(), (ROOT / "docs" / "what_if.md").read_text()
    code = re.sub(r'^\s*""".*?"""\n', "", text, flags=re.MULTILINE | re.DOTALL)
    shown = next(block for block in blocks(page, "python") if "class CrossingPlans" in block)
    assert [line for line in code.splitlines() if line] == [line for line in shown.splitlines() if line]
    assert len([line for line in code.splitlines() if line]) <= 20


@pytest.mark.parametrize("robot", [[0.0, -4.0, 0.0, 0.5], [1.0, 0.0, 1.7, -0.5], [-7.9, -5.0, -0.9, 0.0]])
def test_the_example_plans_what_the_robot_then_does(robot: list[float]):
    """Also when it drifts sideways, which its first action ends in part, and at the walls."""
    from crossing_plans import CrossingPlans

    importlib.import_module("crossing_reader")
    model, horizon = CrossingPlans(), 4
    for plan, name in enumerate(model.names):
        env = gym.make("Crossing-v0")
        env.reset(seed=1)
        env.unwrapped.robot[:] = robot  # type: ignore[attr-defined]
        plans = checked_plans(model, env, horizon, 4)
        assert plans.rewards is not None
        for step in range(horizon):
            sideways = env.unwrapped.robot[2]  # type: ignore[attr-defined]
            action = plans.actions[plan] if step == 0 else np.array([-sideways, plans.actions[plan][1]]).clip(-1, 1)
            _, reward, *_ = env.step(action)
            np.testing.assert_allclose(env.unwrapped.robot, plans.states[plan, step], atol=1e-6, err_msg=name)  # type: ignore[attr-defined]
            assert reward == pytest.approx(plans.rewards[plan, step])


def test_the_planner_drives_the_example():
    from crossing_plans import CrossingPlans

    importlib.import_module("crossing_reader")
    env = gym.make("Crossing-v0")
    env.reset(seed=0)
    spec = reader_for(env).spec
    planner = Planner(env, ConstantVelocity(spec, horizon_steps=8), CrossingPlans())
    for _ in range(60):
        *_, terminated, truncated, _ = env.step(planner())
        if terminated or truncated:
            break
    assert env.unwrapped.robot[1] >= 5.0  # type: ignore[attr-defined]  # the other wall
