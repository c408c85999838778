from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest

from agents.studies.plan import SHIPPED, StudyArm, read_study, shipped_studies, study_file, task_for
from agents.task import Observe
from predictor.support.errors import UserError
from tests.agents.studies.helpers import study_path, study_text


def test_every_study_that_ships_is_read():
    assert "quick" in shipped_studies()
    for name in shipped_studies():
        study = read_study(study_file(name))
        assert study.name == name and study.title and study.scenarios and study.arms
        for scenario in study.scenarios:
            options = {key: value for key, value in scenario.options.items() if key != "backend"}  # needs EnvPool 1.2.7
            for arm in (*study.arms, StudyArm("none", "none", {})):
                assert task_for(replace(scenario, options=options), arm, name).observe == arm.observe


def test_a_study_is_read(tmp_path: Path):
    text = study_text(seeds="[4, 7]", arms='["none", {name = "cv", observe = "constant-velocity"}]', rivals='["none"]')
    text += 'steps = 99\nreferences = ["idle"]\n[scenarios.merge-v1]\n'
    study = read_study(study_path(tmp_path, text))
    assert study.name == "corridor" and study.training_seeds == (4, 7) and study.compared_with == ("none",)
    assert study.arms == (StudyArm("none", "none", {}), StudyArm("cv", "constant-velocity", {}))
    first, second = study.scenarios
    assert (first.steps, first.references) == (99, ("idle",)), "a scenario's own"
    assert (second.env_id, second.steps, second.references) == ("merge-v1", 512, ("random", "constant-actions"))


def test_algorithms_may_be_tables_of_hyperparameters(tmp_path: Path):
    text = study_text() + "[algorithms.ppo]\nlearning_rate = 3e-4\nnet_arch = [64]\n[algorithms.recurrent-ppo]\n"
    study = read_study(study_path(tmp_path, text.replace('algorithms = ["ppo"]\n', "")))
    assert study.algorithms == ("ppo", "recurrent-ppo")
    assert study.settings == {"ppo": {"learning_rate": 3e-4, "net_arch": (64,)}, "recurrent-ppo": {}}
    assert read_study(study_path(tmp_path, study_text())).settings == {}


def test_an_arm_names_a_checkpoint_by_scenario(tmp_path: Path):
    text = study_text(arms='["none", {name = "lstm", observe = "forecast", checkpoint = "runs/{scenario}/{env_id}"}]')
    text = text.replace(text[text.rindex("env_id") :], 'env_id = "merge-v1"\ncheckpoint = "shared"\n')
    study = read_study(study_path(tmp_path, text))
    none, lstm = (task_for(study.scenarios[0], arm, "file") for arm in study.arms)
    assert lstm.checkpoint == "runs/corridor/merge-v1" and none.checkpoint is None
    assert task_for(study.scenarios[0], StudyArm("forecast", "forecast", {}), "file").checkpoint == "shared"
    for arm in ("zeros", "constant-velocity", "forecast"):
        assert task_for(study.scenarios[0], StudyArm(arm, arm, {}), "file").sizes_of == "shared"
    assert lstm.sizes_of == "shared" and none.sizes_of is None


@pytest.mark.parametrize("arm", get_args(Observe))
def test_a_checkpoint_of_a_scenario_goes_to_every_arm_that_takes_one(tmp_path: Path, arm: Observe):
    text = study_text(arms=f'["{arm}"]')
    own = 'env_id = "merge-v1"\ncheckpoint = "shared"\nnum_samples = 6\nwhat_if = true\n'
    study = read_study(study_path(tmp_path, text.replace(text[text.rindex("env_id") :], own)))
    task = task_for(study.scenarios[0], study.arms[0], "file")
    assert task.checkpoint == (None if arm in ("none", "constant-velocity") else "shared")


@pytest.mark.parametrize("checkpoint", ["constant-velocity", "own:mine:make"])
def test_a_checkpoint_without_sizes_leaves_all_arms_those_of_the_shipped_one(tmp_path: Path, checkpoint: str):
    """The arm that shows it had the sizes of what it shows, and so another network than its controls."""
    text = study_text(arms='["zeros", "constant-velocity", "forecast"]')
    own = f'env_id = "merge-v1"\ncheckpoint = "{checkpoint}"\n'
    study = read_study(study_path(tmp_path, text.replace(text[text.rindex("env_id") :], own)))
    tasks = [task_for(study.scenarios[0], arm, "file") for arm in study.arms]
    assert [(task.checkpoint, task.sizes_of) for task in tasks] == [
        (checkpoint, "merge"), (None, "merge"), (checkpoint, "merge"),
    ]  # fmt: skip


def test_arms_with_forecasters_of_their_own_have_the_sizes_of_the_others(tmp_path: Path):
    arms = '["zeros", "forecast", {name = "mine", observe = "forecast", checkpoint = "runs/mine"}]'
    study = read_study(study_path(tmp_path, study_text(arms=arms, env_id="merge-v1")))
    zeros, shipped, mine = (task_for(study.scenarios[0], arm, "file") for arm in study.arms)
    assert (zeros.sizes_of, shipped.sizes_of, mine.sizes_of) == (None, None, "merge")
    asked = StudyArm("mine", "forecast", {"checkpoint": "runs/mine", "sizes_of": "runs/mine"})
    assert task_for(study.scenarios[0], asked, "file").sizes_of == "runs/mine"


def test_what_a_scenario_says_of_forecasts_goes_to_the_arms_that_have_any(tmp_path: Path):
    text = study_text(arms='["none", "zeros"]')
    own = 'env_id = "highway-fast-v0"\nwhat_if = true\nperception_m = 9.0\n'
    text = text.replace(text[text.rindex("env_id") :], own)
    study = read_study(study_path(tmp_path, text))
    none, zeros = (task_for(study.scenarios[0], arm, "file") for arm in study.arms)
    assert (none.what_if, none.perception_m, zeros.what_if, zeros.perception_m) == (False, None, True, 9.0)
    with pytest.raises(UserError, match="arm none: what_if has no effect with observe=none"):
        task_for(study.scenarios[0], StudyArm("none", "none", {"what_if": True}), "file")


def test_the_ceiling_of_plans_may_stand_over_true_futures_as_floor(tmp_path: Path):
    text = study_text(floor='"oracle"')
    own = 'env_id = "highway-fast-v0"\nwhat_if = true\n'
    study = read_study(study_path(tmp_path, text.replace(text[text.rindex("env_id") :], own)))
    assert (study.floor, study.ceiling) == ("oracle", "oracle-what-if")
    with pytest.raises(UserError, match="floor and ceiling must be two arms, got 'oracle' for both"):
        read_study(study_path(tmp_path, text))


def test_what_the_file_says_of_a_cell_is_what_changes_its_result(tmp_path: Path):
    arms = '["none", "zeros"]'
    text = study_text(arms=arms)
    own = 'env_id = "highway-fast-v0"\nnum_samples = 6\n'
    text = text.replace(text[text.rindex("env_id") :], own)

    def said(text: str) -> list[dict[str, Any]]:
        study = read_study(study_path(tmp_path, text))
        (scenario,) = study.scenarios
        lines = [study.settings_of(scenario, arm, "ppo") for arm in study.arms]
        return [study.settings_of(scenario), *lines]

    before = said(text)
    assert said(text) == before and before[0] != before[1] != before[2]

    def changed(other: str) -> list[bool]:
        return [now != then for now, then in zip(said(other), before, strict=True)]

    assert changed(text.replace("num_samples = 6", "num_samples = 7")) == [False, False, True]
    assert changed(text + 'env_kwargs = "{\\"config\\": {\\"vehicles_density\\": 3}}"\n') == [True, True, True]
    assert changed(text + "steps = 77\n") == [False, True, True]
    orders = [said(f"{text}env_kwargs = {{config = {{{order}}}}}\n") for order in ("a = 1, b = 2", "b = 2, a = 1")]
    assert orders[0] == orders[1]
    assert changed(study_text(arms=arms, episodes="7") + own[own.index("num") :]) == [True, True, True]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title = ", r"corridor.toml is not valid TOML: Invalid value"),
        (study_text(arms='["nobody"]'), "corridor.toml: arms: unknown arm 'nobody'; there are forecast, none"),
        (study_text(arms="[]"), "corridor.toml: key 'arms' must be an array of at least one arm"),
        (study_text(arms='["none", "none"]'), "corridor.toml: arms has 'none' 2 times; give each a name of its own"),
        (study_text(arms='[{name = "lstm"}]'), "unknown arm 'lstm'; .*; a table with another name needs the"),
        (study_text(arms="[3]"), "corridor.toml: arms must hold names or tables with a name, got 3"),
        (study_text(arms='[{name = "none", chekpoint = "a"}]'), "corridor.toml: arms.none: unknown key 'chekpoint'"),
        (study_text(arms='[{name = "none", checkpoint = 3}]'), "arms.none: checkpoint must be a text, got 3"),
        (
            study_text(arms=f'[{{name = "{"a" * 65}", observe = "none"}}]'),
            "a name is part of a folder's and has at most 64 signs, got 65",
        ),
        (study_text(arms='[{name = "a/b", observe = "none"}]'), "a name has letters, digits, - and _ alone, got 'a/b'"),
        (study_text(step="3"), "corridor.toml: unknown key 'step'; did you mean steps\\? There are title, algorithms,"),
        (study_text(steps="0"), "corridor.toml: steps must be at least 1, got 0"),
        (study_text(steps='"many"'), "corridor.toml: steps must be a whole number, got 'many'"),
        (study_text(episodes="20000"), "corridor.toml: episodes must be at most 10,000, got 20000"),
        (study_text(selection_episodes="20000"), "corridor.toml: selection_episodes must be at most 10,000, got 20000"),
        (study_text(steps="true"), "corridor.toml: steps must be a whole number, got True"),
        (study_text(seeds="0"), "corridor.toml: seeds must be at least 1, got 0"),
        (study_text(seeds="[1, 1]"), r"corridor.toml: seeds must be a number or different numbers, got \[1, 1\]"),
        (study_text(seeds="[0, 0.5]"), r"corridor.toml: seeds\[1\] must be a whole number, got 0.5"),
        (study_text(seeds="[-1]"), r"corridor.toml: seeds must lie in \[0, 1000000000\), got -1"),
        (study_text(algorithms='["sacc"]'), r"corridor.toml: algorithms\[0\] must be one of ppo, dqn.*, got 'sacc'"),
        (study_text(algorithms='"ppo"'), "corridor.toml: algorithms must be an array, got 'ppo'"),
        (study_text(algorithms="{sacc = {}}"), "corridor.toml: algorithms.sacc: no such algorithm; there are ppo, dqn"),
        (study_text(algorithms="{ppo = 3}"), "corridor.toml: algorithms.ppo must be a table, got 3"),
        (study_text(algorithms="{}"), "corridor.toml: algorithms must name at least one"),
        (study_text(algorithms='["ppo", "ppo"]'), r"corridor.toml: .* each once, got \['ppo', 'ppo'\]"),
        (
            study_text(algorithms="{ppo = {lr = 3e-4}}"),
            "corridor.toml: algorithms.ppo: ppo has no hyperparameter 'lr'; there are learning_rate, gamma, ",
        ),
        (
            study_text(algorithms="{ppo = {n_steps = 3.5}}"),
            "corridor.toml: algorithms.ppo: n_steps must be a whole number, got 3.5",
        ),
        (study_text(rivals='["none", "none"]'), r"corridor.toml: rivals must name arms, each once, got .*'none'\]"),
        (
            study_text(arms='["none", {name = "long", observe = "none", env_kwargs = {duration = 60}}]'),
            "corridor.toml: arms.long: env_kwargs would let this arm play another environment; give it to a scenario",
        ),
        (
            study_text(arms='["none", {name = "other", observe = "none", learners = ["agent_0"]}]'),
            "corridor.toml: arms.other: learners would let this arm play another environment",
        ),
        (study_text(rivals='["zeroes"]'), "corridor.toml: rivals names 'zeroes', which is no arm; there are none"),
        (study_text(floor='"zeroes"'), "corridor.toml: floor must be an arm of the study or one of forecast.*'zeroes'"),
        (study_text(ceiling='"orcale"'), "corridor.toml: ceiling must be an arm of the study or one of .*'orcale'"),
        (study_text(floor='"zeros"', ceiling='"zeros"'), "floor and ceiling must be two arms, got 'zeros'"),
        (
            study_text() + "env_kwargs = {since = 2020-01-01}\n",
            r"corridor.toml: scenarios.corridor: env_kwargs must hold what JSON has \(no dates or times\): .* date",
        ),
        (study_text() + "backend = 3\n", "corridor.toml: scenarios.corridor: backend must be one of gymnasium"),
        (study_text() + "arm = 3\n", "corridor.toml: scenarios.corridor: unknown key 'arm'; there are env_id, steps"),
        (study_text() + "num_envs = 0\n", "corridor.toml: scenarios.corridor: num_envs must be at least 1, got 0"),
        ('arms = ["none"]\n', "corridor.toml: key 'scenarios' is missing"),
    ],
)  # fmt: skip
def test_bad_files_are_named_with_their_key(text: str, message: str, tmp_path: Path):
    with pytest.raises(UserError, match=message) as error:
        read_study(study_path(tmp_path, text))
    assert str(error.value).count("corridor.toml") == 1 and "\n" not in str(error.value)


def test_options_that_do_not_fit_an_arm_are_named(tmp_path: Path):
    study = read_study(study_path(tmp_path, study_text(arms='[{name = "none", checkpoint = "highway"}]')))
    with pytest.raises(UserError, match="^f.toml: scenario corridor, arm none: checkpoint 'highway' has no effect"):
        task_for(study.scenarios[0], study.arms[0], "f.toml")


def test_an_unknown_study_is_named():
    with pytest.raises(UserError, match=r"no study 'quik': neither a file nor one that ships \(.*quick"):
        study_file("quik")


def test_headroom_has_floor_and_ceiling_alone(tmp_path: Path):
    text = study_text(floor='"none"', ceiling='"forecast"', references='["random", "planner@0.3", "slower", "planner"]')
    study = read_study(study_path(tmp_path, text)).headroom_only()
    assert study.arm_names == ("none", "forecast")
    assert study.scenarios[0].references == ("planner@0.3", "slower", "planner")
    text = study_text(floor='"ground"', ceiling='"forecast"')
    with pytest.raises(UserError, match="floor must be an arm of the study or one of .*, got 'ground'"):
        read_study(study_path(tmp_path, text)).headroom_only()


@pytest.mark.parametrize(
    ("name", "ceiling"), [("costly", "oracle-what-if"), ("predators", "oracle"), ("quick", "oracle")]
)
def test_where_policies_score_their_plans_the_ceiling_shows_the_future_in_each(name: str, ceiling: str):
    """The entries of plans are zero in `oracle`."""
    study = read_study(study_file(name)).headroom_only()
    assert study.arm_names == ("zeros", ceiling)
    for scenario in study.scenarios:
        assert task_for(scenario, study.arms[1], name).what_if == (ceiling == "oracle-what-if")


def test_a_ceiling_that_the_file_names_is_kept(tmp_path: Path):
    text = (SHIPPED / "costly.toml").read_text()
    path = tmp_path / "named.toml"
    path.write_text('ceiling = "oracle"\n' + text)
    assert read_study(path).ceiling == "oracle"


def test_arms_are_those_of_the_task():
    assert {"none", "constant-velocity", "forecast"} <= set(get_args(Observe))


def test_drivers_beside_the_arms_are_those_that_the_environment_has(tmp_path: Path):
    text = study_text().replace('references = ["random", "constant-actions"]\n', "") + "[scenarios.simple_tag_v3]\n"
    one, many = read_study(study_path(tmp_path, text)).scenarios
    assert one.references == ("planner", "constant-actions", "random", "idle") and many.references == ("random", "idle")
