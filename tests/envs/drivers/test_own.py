import copy
import threading
from typing import Any

import numpy as np
import pytest

from agents.evaluate import checked_drivers
from agents.task import Task
from envs.drivers.all_agents import make_driver
from envs.drivers.ego import make_ego_driver
from envs.drivers.own import OwnDriver
from envs.drivers.trained import trained_driver
from envs.rollouts.world import open_world
from envs.sb3.policy_file import PolicyNote
from envs.supervision import EnvironmentFailedError
from predictor.support.errors import UserError
from tests.envs.drivers.test_trained import SPREAD, forecast_env, save_run

ROAD = "highway-fast-v0"
BRAKES, DODGES, FLOCK, NUMBER, RAISES = (
    f"own:tests.envs.own_code:{name}" for name in ("brakes", "Dodges", "flock", "a_number", "raises")
)


def states(env_id: str, driver: str, seed: int, checkpoint: str | None = None, steps: int = 4) -> list[np.ndarray]:
    world = open_world(env_id, driver, checkpoint)
    world.reset(seed)
    found = [world.full_scene().states]
    for _ in range(steps):
        if world.step():
            break
        found.append(world.full_scene().states)
    world.close()
    return found


def test_an_ego_does_what_the_users_function_says():
    braked = states(ROAD, BRAKES, seed=3)
    for own, known in zip(braked, states(ROAD, "slower", seed=3), strict=True):
        np.testing.assert_array_equal(own, known)
    assert braked[-1][0, 2] < braked[0][0, 2] - 4.0


@pytest.mark.parametrize(("env_id", "driver"), [(ROAD, DODGES), (SPREAD, FLOCK)])
def test_an_episode_is_a_function_of_its_seed(env_id: str, driver: str):
    first = [states(env_id, driver, seed) for seed in range(4)]
    for one, again in zip(first, [states(env_id, driver, seed, "constant-velocity") for seed in range(4)], strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one, again, strict=True))


def test_all_agents_do_what_the_users_function_says():
    found = states(SPREAD, FLOCK, seed=1)
    moved = (found[-1] - found[0])[:3, :2]
    np.testing.assert_allclose(moved[1:], np.broadcast_to(moved[:1], (2, 2)), atol=0.2)  # agents may push each other
    assert np.abs(moved).max() > 0.2


def test_a_world_takes_it_over():
    world = open_world(ROAD, "idle")
    world.drive(BRAKES)
    world.reset(3)
    world.step()
    np.testing.assert_array_equal(world.full_scene().states, states(ROAD, "slower", seed=3)[1])
    with pytest.raises(UserError, match="driver must be one of random"):
        world.drive("absent")


def counts_on_itself(env: Any, rng: np.random.Generator) -> Any:
    """Keeps its count as an attribute, and a lock, which cannot be copied."""
    lock = threading.Lock()

    def act(observation: Any) -> int:
        with lock:
            act.steps += 1  # type: ignore[attr-defined]
        return act.steps % 5  # type: ignore[attr-defined]

    act.steps = 0  # type: ignore[attr-defined]
    return act


def follows_a_list(env: Any, rng: np.random.Generator) -> Any:
    """Takes its actions from a generator, whose place no copy can have."""
    actions = (int(rng.integers(5)) for _ in range(99))
    return lambda observation: next(actions)


def test_copies_count_for_themselves_and_share_what_cannot_be_copied():
    driver = OwnDriver(f"own:{__name__}:counts_on_itself", None, np.random.default_rng(0))
    assert [driver(None), driver(None)] == [1, 2]
    copied = copy.deepcopy(driver)
    assert [copied(None), copied(None)] == [3, 4] and driver(None) == 3


def counts_in_a_shared_variable(env: Any, rng: np.random.Generator) -> Any:
    """Two functions share a count."""
    count = 0

    def bump() -> None:
        nonlocal count
        count += 1

    def act(observation: Any) -> int:
        bump()
        return count % 5

    return act


def test_functions_share_their_variables_in_a_copy():
    driver = OwnDriver(f"own:{__name__}:counts_in_a_shared_variable", None, np.random.default_rng(0))
    assert [driver(None), driver(None)] == [1, 2]
    copied = copy.deepcopy(driver)
    assert [copied(None), copied(None)] == [3, 4] and driver(None) == 3


def counts_in_a_default(env: Any, rng: np.random.Generator) -> Any:
    """Keeps its count in a default, without a closure."""

    def act(observation: Any, counted: list[int] = [0], *, twice: list[int] = [0]) -> int:  # noqa: B006
        counted[0] += 1
        twice[0] += 2
        return counted[0] + twice[0]

    return act


def test_functions_have_their_own_defaults_in_a_copy():
    driver = OwnDriver(f"own:{__name__}:counts_in_a_default", None, np.random.default_rng(0))
    assert [driver(None), driver(None)] == [3, 6]
    copied = copy.deepcopy(driver)
    assert [copied(None), copied(None)] == [9, 12] and driver(None) == 9


def counting(observation: Any) -> int:
    counting.steps = getattr(counting, "steps", 0) + 1  # type: ignore[attr-defined]
    return 1


def counts_by_its_name(env: Any, rng: np.random.Generator) -> Any:
    """Keeps its count as an attribute that it finds by its name, which is that of the original in every copy."""
    return counting


def test_a_function_that_finds_its_attributes_by_its_name_is_not_copied():
    driver = OwnDriver(f"own:{__name__}:counts_by_its_name", None, np.random.default_rng(0))
    driver(None)
    with pytest.raises(UserError, match="whose function counting keeps attributes of itself cannot be copied"):
        copy.deepcopy(driver)


def test_a_driver_with_a_place_in_a_sequence_is_not_copied():
    driver = OwnDriver(f"own:{__name__}:follows_a_list", None, np.random.default_rng(0))
    driver(None)
    with pytest.raises(UserError, match="a driver of your own that keeps a generator cannot be copied with its env"):
        copy.deepcopy(driver)


def test_it_stands_beside_a_policy():
    task = Task(ROAD, "none")
    assert checked_drivers(task, (BRAKES, "slower")) == (BRAKES, "slower")
    with pytest.raises(UserError, match="has no function or class 'absent'"):
        checked_drivers(task, ("own:tests.envs.own_code:absent",))


@pytest.mark.parametrize(("env_id", "make"), [(ROAD, make_ego_driver), (SPREAD, make_driver)])
@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "own:absent_module:drive",
            "cannot import 'absent_module' for 'absent_module:drive'.*package installed",
        ),
        ("own:tests.envs.own_code:absent", "module 'tests.envs.own_code' has no function or class 'absent'"),
        ("own:drive", "a driver of your own is own:module:function, got 'own:drive'"),
    ],
)
def test_a_name_that_stands_for_nothing_is_one_sentence(env_id: str, make: Any, name: str, sentence: str):
    env = Task(env_id, "none").make()
    with pytest.raises(UserError, match=sentence):
        make(name, env, np.random.default_rng(0))


CODE = "own:tests.envs.own_code:"


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (NUMBER, f"driver '{NUMBER}' must give a function from observations to actions, got int"),
        (RAISES, f"highway-fast-v0, seed 0, step 1: driver '{RAISES}' failed: KeyError: 'goal'"),
        (f"{CODE}takes_nothing", r"is called as function\(env, rng\): takes_nothing\(\) takes 0 positional arguments"),
        (f"{CODE}adds_a_text", f"driver '{CODE}adds_a_text' failed: TypeError: unsupported operand"),
        (f"{CODE}sees_nothing", "gives a function that is called with an observation: .* takes 0 positional arguments"),
        (f"{RAISES}_later", f"highway-fast-v0, seed 0, step 1: driver '{RAISES}_later' failed: KeyError: 'goal'"),
    ],
)
def test_a_function_that_fails_is_named(name: str, sentence: str):
    world = open_world(ROAD, name)
    world.reset(0)
    with pytest.raises(EnvironmentFailedError, match=sentence):
        world.step()


def test_a_policys_note_imports_nothing(tmp_path: Any, monkeypatch: pytest.MonkeyPatch):
    path, _ = save_run(tmp_path, Task(SPREAD, "none", learners=("agent_0",)))
    note = PolicyNote(None, ("agent_0",), "own:os:system", SPREAD)
    monkeypatch.setattr("envs.drivers.trained.note_of", lambda path: note)
    with pytest.raises(UserError, match="the note names driver 'own:os:system', which imports code"):
        trained_driver(path, forecast_env(), np.random.default_rng(0))
