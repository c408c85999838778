from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from stable_baselines3 import PPO

from agents.presets import PPOPreset, QRDQNPreset
from agents.studies.cells import NETWORK, Cell, cells_of, run_cell
from agents.studies.plan import read_study
from agents.studies.results import read_result
from envs.drivers.content import content_of_module
from envs.drivers.planner import PlannerConfig
from envs.registry import make_env
from predictor.checkpoint import read_info, resolve
from predictor.support.errors import UserError
from tests.agents.studies.helpers import study_path, study_text

HIGHWAY = "highway-fast-v0"


@pytest.fixture
def cells(tmp_path: Path) -> Callable[..., list[Cell]]:
    return lambda **changes: cells_of(read_study(study_path(tmp_path, study_text(**changes))), "corridor.toml")


def test_cells_are_the_product_and_the_drivers(cells: Callable[..., list[Cell]]):
    found = cells(algorithms='["ppo", "dqn"]')
    assert [(c.line, c.algorithm, c.seed) for c in found] == [
        ("random", None, None), ("action-0", None, None), ("action-1", None, None),
        ("none", "ppo", 0), ("none", "ppo", 1), ("none", "dqn", 0), ("none", "dqn", 1),
    ]  # fmt: skip
    assert found[3].title == "corridor, none, ppo, seed 0" and found[0].title == "corridor, random"
    assert len({cell.name for cell in found}) == 7 and found[3].name.startswith("corridor.none.ppo.0-")


def test_what_determines_a_result_is_in_the_name(cells: Callable[..., list[Cell]], monkeypatch: pytest.MonkeyPatch):
    before = {cell.title: cell.name for cell in cells()}
    same = {"seeds": "3", "title": '"other"', "rivals": '["none"]'}
    assert before.items() <= {cell.title: cell.name for cell in cells(**same)}.items(), "finished cells stay"
    trained, drivers = {t for t in before if "none" in t}, {t for t in before if "none" not in t}
    for changes, other in (
        ({"steps": "513"}, trained),
        ({"num_envs": "2"}, trained),
        ({"selection_episodes": "4"}, trained),
        ({"checkpoint_every": "99"}, trained),
        ({"episodes": "5"}, trained | drivers),
        ({"algorithms": "{ppo = {gamma = 0.7}}"}, trained),
        ({"algorithms": "{ppo = {gamma = 0.99}}"}, set()),
    ):
        after = {cell.title: cell.name for cell in cells(**changes)}
        assert {title for title in before if after[title] != before[title]} == other, changes
    monkeypatch.setattr("agents.studies.cells.installed_version", lambda name: "0.0")
    assert not set(before.values()) & {cell.name for cell in cells()}


def test_a_long_name_of_a_driver_still_makes_a_folder(cells: Callable[..., list[Cell]]):
    path = "/".join(["ä" * 100] * 3)
    found = [replace(cells()[0], line=f"planner:{path}/{end}").name for end in ("one", "two")]
    assert len(set(found)) == 2 and max(len(name.encode()) for name in found) <= 255


def test_sizes_of_forecasts_are_not_in_the_names_of_cells_without_any(tmp_path: Path):
    def names(more: str) -> list[str]:
        return [cell.name for cell in cells_of(read_study(study_path(tmp_path, study_text() + more)), "corridor.toml")]

    assert names("num_samples = 6\nhorizon_steps = 3\n") == names("") != names("env_kwargs = {sleep_s = 0.001}\n")


def test_the_code_of_a_driver_of_ones_own_is_in_the_name(
    cells: Callable[..., list[Cell]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.syspath_prepend(tmp_path)
    module, names = tmp_path / "my_study_driver.py", []
    for action in (0, 1):
        module.write_text(f"def drive(env, rng):\n    return lambda observation: {action}\n")
        names.append(next(c.name for c in cells(references='["own:my_study_driver:drive"]') if "own" in c.line))
    assert names[0] != names[1]


def test_the_code_of_a_forecaster_of_ones_own_is_in_the_name(
    cells: Callable[..., list[Cell]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.syspath_prepend(tmp_path)
    module, code, names = tmp_path / "my_study_forecaster.py", Path("docs/examples/mean_velocity.py").read_text(), []
    arms = '[{name = "own", observe = "forecast", checkpoint = "own:my_study_forecaster:MeanVelocity"}]'
    for ending in ("", "\n# changed\n"):
        module.write_text(code + ending)
        names += [c.name for c in cells(env_id=HIGHWAY, seeds="1", arms=arms, references="[]")]
    assert len(set(names)) == 2


def test_only_what_concerns_a_cell_is_in_its_name(cells: Callable[..., list[Cell]]):
    """So that cells which are finished stay."""
    none, zeros = cells(env_id=HIGHWAY, seeds="1", arms='["none", "zeros"]', references="[]")
    assert "network" not in none.content and zeros.content["network"] == NETWORK
    assert not {"shaping", "vf_coef", "target_kl"} & {*none.content["plan"], *none.content["preset"]}
    (tag,) = cells(env_id="simple_tag_v3", seeds="1", arms='["none"]', references="[]")
    assert tag.content["plan"]["shaping"] is True and tag.content["preset"]["vf_coef"] == 0.005
    assert tag.content["preset"]["target_kl"] == 0.01


def test_a_driver_that_is_listed_twice_is_one_cell(cells: Callable[..., list[Cell]]):
    for env_id in (HIGHWAY, "simple_tag_v3"):
        found = cells(env_id=env_id, seeds="1", arms='["none"]', references='["random", "random"]')
        assert len([cell for cell in found if cell.plan is None]) == 1, env_id


def test_opponents_do_not_learn_unless_the_study_says_so(tmp_path: Path):
    def cell(options: str) -> Cell:
        text = f'arms = ["none"]\nseeds = 1\nreferences = []\n[scenarios.tag]\nenv_id = "simple_tag_v3"\n{options}'
        return cells_of(read_study(study_path(tmp_path, text)), "tag.toml")[0]

    tag, all_learn = cell(""), cell("learners = []")
    assert tag.task.learners == ("adversary",) and all_learn.task.learners == ()
    assert tag.name != all_learn.name


def test_settings_of_an_algorithm_are_those_of_its_trainings(cells: Callable[..., list[Cell]]):
    found = cells(algorithms="{ppo = {gamma = 0.7, net_arch = [64]}, qrdqn = {}}", seeds="1")
    presets = {cell.algorithm: cell.plan.preset for cell in found if cell.plan is not None}
    assert presets == {"ppo": PPOPreset(gamma=0.7, net_arch=(64,)), "qrdqn": QRDQNPreset(gamma=0.99)}
    versions = {cell.algorithm: set(cell.content["versions"]) for cell in found}
    assert versions["qrdqn"] - versions["ppo"] == {"sb3-contrib"}, "cells of other algorithms do not depend on it"


def test_the_version_of_a_simulator_is_in_the_names_of_the_cells_that_it_trains(cells: Callable[..., list[Cell]]):
    pytest.importorskip("envpool")
    arms = '["none", {name = "fast", observe = "none", backend = "envpool"}]'
    found = {cell.line: set(cell.content["versions"]) for cell in cells(env_id=HIGHWAY, arms=arms, seeds="1")}
    assert found["fast"] - found["none"] == {"envpool"} and "envpool" not in found["random"]


def test_the_forecaster_is_in_the_name(cells: Callable[..., list[Cell]]):
    one, other, third = (
        cells(env_id=HIGHWAY, seeds="1", arms=f'[{{name = "a", observe = "forecast", checkpoint = "{name}"}}]')[-1]
        for name in ("highway", "merge", "highway")
    )
    assert one.name == third.name != other.name and one.forecaster != other.forecaster


@pytest.mark.slow
def test_a_policy_that_drives_is_in_the_name_by_its_content(cells: Callable[..., list[Cell]], tmp_path: Path):
    path = tmp_path / "policy.zip"

    def name(seed: int) -> str:
        sizes = {"n_steps": 4, "batch_size": 4, "policy_kwargs": {"net_arch": [4]}}
        PPO("MlpPolicy", make_env(HIGHWAY), seed=seed, **sizes).save(path)
        first, again = (cells(env_id=HIGHWAY, seeds="1", references=f'["{path}"]')[0] for _ in range(2))
        assert first.line == str(path) and first.name == again.name
        return first.name

    assert name(0) != name(1)


def test_the_planners_settings_are_in_the_name(cells: Callable[..., list[Cell]], monkeypatch: pytest.MonkeyPatch):
    def names() -> dict[str, str]:
        drivers = '["planner", "planner:oracle", "planner@0.3", "slower"]'
        made = cells(env_id=HIGHWAY, seeds="1", arms='["none"]', references=drivers)
        risks.update({cell.line: cell.forecaster["max_risk"] for cell in made if cell.forecaster})
        return {cell.title: cell.name for cell in made}

    risks: dict[str, float] = {}
    before = names()
    assert risks == {"planner": 0.05, "planner:oracle": 0.05, "planner@0.3": 0.3}
    assert len(set(before.values())) == len(before)
    monkeypatch.setattr("agents.studies.cells.planner_config", lambda _: PlannerConfig(max_risk=0.7))
    changed = {title for title, name in names().items() if name != before[title]}
    assert changed == {"corridor, planner", "corridor, planner:oracle", "corridor, planner@0.3"}


def test_how_far_true_futures_reach_is_in_the_name(cells: Callable[..., list[Cell]], monkeypatch: pytest.MonkeyPatch):
    """They are as long and as wide as those of the checkpoint that ships."""
    text = {"env_id": HIGHWAY, "seeds": "1", "arms": '["none"]', "references": '["planner:oracle"]'}
    before = cells(**text)[0].name
    info = read_info(resolve("highway"))
    assert cells(**text)[0].name == before
    for other in (replace(info, horizon_steps=9, std_m=()), replace(info, spec=replace(info.spec, perception_m=50.0))):
        monkeypatch.setattr("agents.studies.cells.read_info", lambda _, other=other: other)
        assert cells(**text)[0].name != before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env_id": "nope-v0"}, "scenario corridor: cannot make env 'nope-v0'"),
        ({"references": '["planer"]'}, "scenario corridor: driver must be one of .*, got 'planer'.* leaves planer out"),
        ({"references": '["planner"]'}, r"scenario corridor: .*; references = .. in the study file leaves planner out"),
        ({"references": '["idle"]', "env_id": "simple_tag_v3", "algorithms": '["dqn"]'}, None),
        ({"env_id": "racetrack-v1", "references": '["constant-actions"]'}, "corridor: constant-actions needs an env"),
        ({"env_id": "racetrack-v1", "references": "[]", "algorithms": '["dqn"]'}, "arm none: dqn needs a discrete act"),
        ({"algorithms": '["tqc"]'}, r"arm none: tqc needs a continuous action space, .* has Discrete\(2\); use ppo"),
        ({"algorithms": "{ppo = {gamma = 2}}"}, r"arm none: ppo: gamma must lie in \[0, 1\], got 2.0"),
        ({"env_id": HIGHWAY, "arms": '[{name = "forecast", checkpoint = "absent"}]'}, "arm forecast: no checkpoint 'a"),
        ({"arms": '["constant-velocity"]', "references": "[]"}, "arm constant-velocity: "),
    ],
)  # fmt: skip
def test_what_cannot_run_is_said_before_anything_runs(
    changes: dict[str, str], message: str | None, cells: Callable[..., list[Cell]]
):
    if message is None:
        assert [cell.line for cell in cells(**changes)] == ["idle", "none", "none"]
        return
    with pytest.raises(UserError, match=f"^corridor.toml: .*{message}") as error:
        cells(**changes)
    assert "\n" not in str(error.value)


def test_the_code_of_an_environment_of_ones_own_is_in_the_name(
    cells: Callable[..., list[Cell]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.syspath_prepend(tmp_path)
    found = list[str | None]()
    for number in (0, 1):
        (tmp_path / "my_study_env.py").write_text(f"REWARD = {number}\n")
        found.append(content_of_module("my_study_env:Own-v0"))
    assert None not in found and found[0] != found[1] and content_of_module("merge-v1") is None
    before = {cell.title: cell.name for cell in cells()}
    monkeypatch.setattr("agents.studies.cells.content_of_module", lambda env_id: f"sha of {env_id}")
    after = {cell.title: cell.name for cell in cells()}
    assert before.keys() == after.keys() and not {*before.values()} & {*after.values()}


def test_only_uneven_measurements_have_another_name(cells: Callable[..., list[Cell]]):
    assert "selections" not in next(c for c in cells(steps="512", selections="2") if c.plan).content
    assert "selections" in next(c for c in cells(steps="512", selections="3") if c.plan).content


def test_where_there_is_a_choice_its_rule_is_in_the_name(cells: Callable[..., list[Cell]]):
    assert "kept" not in next(c for c in cells(steps="512", selections="1") if c.plan).content
    assert next(c for c in cells(steps="512", selections="2") if c.plan).content["kept"] == "highest mean"


def test_a_result_says_what_the_file_said(cells: Callable[..., list[Cell]], tmp_path: Path):
    """By it `--report` tells results of other settings apart."""
    for cell in (cells()[0], cells()[-1]):
        assert cell.settings and cell.settings["episodes"] == cell.episodes
        assert ("steps" in cell.settings) == (cell.plan is not None)
    driver = cells()[0]
    assert run_cell(driver, tmp_path / "cell", "commit").settings == driver.settings
    assert read_result(tmp_path / "cell" / "result.json").settings == driver.settings
