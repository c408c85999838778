"""Study files: what is compared on what, with how many seeds; read from TOML and checked before anything runs.

`docs/study.md` explains every key. A file that ships is named by its stem ("quick"), any other one by its path.
"""

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

from agents.preset_settings import settings_from_table
from agents.presets import Algorithm
from agents.results import MOST_EPISODES
from agents.task import NO_CHECKPOINT, SELECTION_SEED, Observe, Task
from envs.drivers.ego import CONSTANT_ACTIONS
from envs.drivers.planner import PLANNER, is_planner
from envs.registry import entry_for, is_multiagent_id
from envs.sb3.algorithms import algorithm_named
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.own_forecasters import is_own
from predictor.support.config_checks import check_at_least, check_at_most, check_choices
from predictor.support.errors import UserError
from predictor.support.memory import ENV_BYTES, check_memory
from predictor.support.reading import MIB, read_toml
from predictor.support.typed_values import converted, from_table

SHIPPED = Path(__file__).resolve().parent
"""Folder of the studies that ship."""
LONGEST_NAME = 64
"""Largest number of signs of the name of an arm or a scenario."""
MOST_SEEDS = 10_000
"""Largest number of training seeds."""
MOST_BYTES = MIB
"""Largest size of a study file."""
REFERENCES = (PLANNER, CONSTANT_ACTIONS, "random", "idle")
MULTIAGENT_REFERENCES = ("random", "idle")
RIVALS = ("zeros", "constant-velocity")
FLOOR, CEILING, CEILING_OF_PLANS = "zeros", "oracle", "oracle-what-if"
_PLACES = ("scenario", "env_id")
"""Names that a text of an arm may hold in braces."""
_OF_FORECASTS = ("perception_m", "what_if", "sizes_of", "num_samples", "horizon_steps")
"""Options of a scenario that an arm without forecasts does not take."""
_NOT_CONSTANT = ("random", "varied", "keep-lane", "heuristic", "mixed")
"""Drivers that take no constant action, beside the planner, trained ones and one's own."""
_OF_SCENARIO = ("env_kwargs", "learners", "driver", "crash_key", "success_key")
"""Fields of `Task` that say which environment is played and what counts in it, which is the same for all arms."""
_OWN = ("env_id", "observe", "timeout_s")
"""Fields of `Task` that are no options: a scenario and an arm say the first two in keys of their own, and a cell runs
its environments in its own process."""


@dataclass(frozen=True)
class StudyArm:
    """What the policy of an arm is shown."""

    name: str
    """Name of the arm in tables."""
    observe: str
    """Value of `Task.observe`."""
    options: Mapping[str, Any]
    """Further fields of `Task`; texts may hold {scenario} and {env_id}."""


@dataclass(frozen=True)
class Scenario:
    """Environment of a study."""

    name: str
    """Name of the scenario in tables."""
    env_id: str
    """Gymnasium or PettingZoo id."""
    options: Mapping[str, Any]
    """Further fields of `Task`, for every arm."""
    steps: int
    """Number of environment steps of a training."""
    num_envs: int
    """Number of environments of a training, all in its process."""
    references: tuple[str, ...]
    """Drivers that are measured without training."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_at_least(self, 1, "steps", "num_envs")
        check_memory(self.num_envs * ENV_BYTES, f"num_envs={self.num_envs:,}", "take fewer")

    def references_among(self, drivers: Iterable[str]) -> list[str]:
        """Returns those drivers that are references of the scenario, in its order; constant actions by their names."""
        there = sorted(set(drivers))
        constant = [each for each in there if is_constant(each) and not is_planner(each)]
        named = (constant if name == CONSTANT_ACTIONS else [name] for name in self.references)
        return [each for each in dict.fromkeys(itertools.chain.from_iterable(named)) if each in there]


@dataclass(frozen=True)
class Study:
    """Everything that a study file says; the keys of the file are the fields from `title` on.

    `algorithms` may be a table, too, of a table of hyperparameters for each algorithm.
    """

    name: str
    """Name of the study: the stem of its file."""
    scenarios: tuple[Scenario, ...]
    """Environments."""
    arms: tuple[StudyArm, ...]
    """Arms, in the order of the tables."""
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Algorithm → hyperparameters in place of those of its preset, where the file has a table for it."""
    title: str = ""
    """Heading of the report; the name of the study if left out."""
    algorithms: tuple[Algorithm, ...] = ("ppo",)
    """Learning algorithms."""
    seeds: int | tuple[int, ...] = 3
    """Training seeds, or their number, counted from 0."""
    steps: int = 20_000
    """Number of environment steps of each training, where a scenario has no number of its own."""
    num_envs: int = 6
    """Number of environments of each training, all in its process, where a scenario has no number of its own."""
    episodes: int = 200
    """Number of test episodes of each policy and driver; all play the same seeds."""
    selections: int = 8
    """Number of times in a training that the policy is measured on the selection seeds, a point of the curve each; at
    most once after each update."""
    selection_episodes: int = 20
    """Number of episodes of each such measurement."""
    checkpoint_every: int = 2_000
    """Number of environment steps between checkpoints, from which a killed training goes on. Episodes end there, so
    `checkpoint_every / num_envs` should be well above their length."""
    references: tuple[str, ...] | None = None
    """Drivers that are measured without training, where a scenario names none of its own; None: the planner, constant
    actions, random and idle, of which PettingZoo's environments have the last two."""
    rivals: tuple[str, ...] | None = None
    """Arms that every other arm is compared with; None: zeros and constant-velocity, where the study has them."""
    floor: str = FLOOR
    """Arm whose policy is shown nothing of the future, from which headroom is counted."""
    ceiling: str = CEILING
    """Arm whose policy is shown the true future, up to which headroom is counted. A file that names none, and whose
    scenarios all have candidate plans (`what_if`), has the arm that shows it in each plan."""

    def __post_init__(self) -> None:
        """Checks ranges and names."""
        check_choices(self)
        check_at_least(self, 1, "steps", "num_envs", "episodes", "selections", "selection_episodes", "checkpoint_every")
        check_at_most(self, MOST_EPISODES, "episodes", "selection_episodes")
        if isinstance(self.seeds, int):
            check_at_least(self, 1, "seeds")
            check_at_most(self, MOST_SEEDS, "seeds")
        elif not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise UserError(f"seeds must be a number or different numbers, got {list(self.seeds)}")
        for seed in self.training_seeds:
            if not 0 <= seed < SELECTION_SEED:
                raise UserError(f"seeds must lie in [0, {SELECTION_SEED}), got {seed}")
        if not self.algorithms or len(set(self.algorithms)) < len(self.algorithms):
            raise UserError(f"algorithms must name at least one, each once, got {list(self.algorithms)}")
        if len(set(self.rivals or ())) < len(self.rivals or ()):
            raise UserError(f"rivals must name arms, each once, got {list(self.rivals or ())}")
        for rival in self.rivals or ():
            if rival not in self.arm_names:
                raise UserError(f"rivals names '{rival}', which is no arm; there are {', '.join(self.arm_names)}")
        for key, name in (("floor", self.floor), ("ceiling", self.ceiling)):
            self._arm_called(name, key)

    @property
    def training_seeds(self) -> tuple[int, ...]:
        """Seeds of the trainings."""
        return tuple(range(self.seeds)) if isinstance(self.seeds, int) else self.seeds

    @property
    def arm_names(self) -> tuple[str, ...]:
        """Names of the arms."""
        return tuple(arm.name for arm in self.arms)

    @property
    def compared_with(self) -> tuple[str, ...]:
        """Names of the arms that every other arm is compared with."""
        named = RIVALS if self.rivals is None else self.rivals
        return tuple(name for name in named if name in self.arm_names)

    def settings_of(
        self, scenario: Scenario, arm: StudyArm | None = None, algorithm: str | None = None
    ) -> dict[str, Any]:
        """Returns what the file says of a cell's result, as JSON content.

        Args:
            scenario: scenario of the cell.
            arm: arm that is trained; None for a driver.
            algorithm: learning algorithm; None for a driver.
        """
        unused = () if arm is not None and arm.observe != "none" else (*_OF_FORECASTS, "checkpoint")
        options = {key: value for key, value in scenario.options.items() if key not in unused}
        said: dict[str, Any] = {"scenario": options, "episodes": self.episodes}
        if arm is not None:
            names = ("selections", "selection_episodes", "checkpoint_every")
            said |= {"observe": arm.observe, "arm": dict(arm.options), "steps": scenario.steps}
            said |= {"num_envs": scenario.num_envs, "settings": dict(self.settings.get(algorithm or "", {}))}
            said |= {name: getattr(self, name) for name in names}
        content: dict[str, Any] = json.loads(json.dumps(said, default=str))
        return content

    def headroom_only(self) -> "Study":
        """Returns the study with floor and ceiling alone, and of its references constant actions and planners.

        Raises:
            UserError: floor or ceiling is neither an arm of the study nor something that a policy can be shown.
        """
        arms = tuple(self._arm_called(name, key) for key, name in (("floor", self.floor), ("ceiling", self.ceiling)))
        scenarios = tuple(
            replace(s, references=tuple(n for n in s.references if is_planner(n) or is_constant(n)))
            for s in self.scenarios
        )
        return replace(self, arms=arms, scenarios=scenarios, rivals=None)

    def _arm_called(self, name: str, key: str) -> StudyArm:
        for arm in self.arms:
            if arm.name == name:
                return arm
        known = get_args(Observe)
        if name not in known:
            raise UserError(f"{key} must be an arm of the study or one of {', '.join(known)}, got '{name}'")
        return StudyArm(name, name, {})


def is_constant(driver: str) -> bool:
    """Returns whether a driver that is no planner takes one action in every step (`CONSTANT_ACTIONS`: one of each)."""
    return driver not in _NOT_CONSTANT and not is_own(driver) and not driver.endswith(".zip")


def shipped_studies() -> tuple[str, ...]:
    """Returns the names of the studies that ship."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def study_file(name: str) -> Path:
    """Returns the file of a study that ships, or the path itself.

    Raises:
        UserError: there is no such study and no such file.
    """
    if name in shipped_studies():
        return SHIPPED / f"{name}.toml"
    path = Path(name)
    if not path.is_file():
        raise UserError(f"no study '{name}': neither a file nor one that ships ({', '.join(shipped_studies())})")
    return path


def read_study(path: Path) -> Study:
    """Reads a study file.

    Raises:
        UserError: the file is no TOML, or a key or value of it does not fit; the message names file and key.
    """
    content = read_toml(path, MOST_BYTES)
    where = path.name
    arms = _arms(content.pop("arms", None), where)
    tables = converted(content.pop("scenarios", None) or {}, dict, f"{where}: scenarios")
    if not tables:
        raise UserError(f"{where}: key 'scenarios' is missing; add a table such as [scenarios.highway-fast-v0]")
    settings = _settings(content, where)
    given = {"name": path.stem, "scenarios": (), "arms": arms, "settings": settings}
    study = from_table(Study, content, where, given)
    scenarios = tuple(_scenario(name, table, study, f"{where}: scenarios.{name}") for name, table in tables.items())
    plans_alone = "ceiling" not in content and all(scenario.options.get("what_if") for scenario in scenarios)
    ceiling = CEILING_OF_PLANS if plans_alone else study.ceiling
    if study.floor == ceiling:
        raise UserError(f"{where}: floor and ceiling must be two arms, got '{ceiling}' for both")
    return replace(study, scenarios=scenarios, ceiling=ceiling)


def task_for(scenario: Scenario, arm: StudyArm, where: str) -> Task:
    """Returns the task of an arm in a scenario.

    A scenario's checkpoint goes to the arms that take one and name none of their own; what it says of forecasts, to the
    arms that are shown any. All of these have the sizes of the scenario's checkpoint, or of the one that ships, where
    the scenario's has none: constant velocity, or a forecaster of one's own.

    Raises:
        UserError: the options of arm and scenario do not fit together; the message begins with `where`.
    """
    places = {"scenario": scenario.name, "env_id": scenario.env_id}
    options = {key: _filled(value, places) for key, value in arm.options.items()}
    shared = dict(scenario.options)
    named = (shared.get("checkpoint"), entry_for(scenario.env_id).checkpoint)
    sizes_of = next((name for name in named if name and name != CONSTANT_VELOCITY and not is_own(name)), None)
    if arm.observe in NO_CHECKPOINT:
        shared.pop("checkpoint", None)
    own = {**shared, **options}.get("checkpoint")
    if sizes_of and ("checkpoint" in scenario.options or (arm.observe == "forecast" and own is not None)):
        shared.setdefault("sizes_of", sizes_of)
    if arm.observe == "none":
        shared = {key: value for key, value in shared.items() if key not in _OF_FORECASTS}
    learners = {"learners": entry_for(scenario.env_id).learners}
    values: dict[str, Any] = {"env_id": scenario.env_id, "observe": arm.observe, **learners, **shared, **options}
    try:
        return Task(**values)
    except UserError as error:
        raise UserError(f"{where}: scenario {scenario.name}, arm {arm.name}: {error}") from error


def _settings(content: dict[str, Any], where: str) -> dict[str, dict[str, Any]]:
    """Returns the hyperparameters of each algorithm that has a table, and puts the algorithms' names in their place.

    Raises:
        UserError: an algorithm or a hyperparameter is unknown, or a value does not fit.
    """
    tables = content.get("algorithms")
    if not isinstance(tables, dict):
        return {}
    settings = {}
    for name, table in tables.items():
        place = f"{where}: algorithms.{name}"
        algorithm = algorithm_named(name)
        if algorithm is None:
            raise UserError(f"{place}: no such algorithm; there are {', '.join(get_args(Algorithm))}")
        settings[name] = settings_from_table(algorithm, converted(table, dict, place), place)
    content["algorithms"] = list(tables)
    return settings


def _arms(listed: Any, where: str) -> tuple[StudyArm, ...]:
    """Returns the arms: each entry is a value of `Observe`, or a table with name, observe and fields of `Task`."""
    if not isinstance(listed, list) or not listed:
        raise UserError(f"{where}: key 'arms' must be an array of at least one arm")
    arms = tuple(_arm(entry, f"{where}: arms") for entry in listed)
    names = [arm.name for arm in arms]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"{where}: arms has '{name}' {names.count(name)} times; give each a name of its own")
    return arms


def _arm(entry: Any, where: str) -> StudyArm:
    table = {"name": entry} if isinstance(entry, str) else entry
    if not isinstance(table, dict) or not isinstance(table.get("name"), str):
        raise UserError(f"{where} must hold names or tables with a name, got {entry!r}")
    name = table["name"]
    _check_name(name, where)
    observe: Any = table.get("observe", name)
    known = get_args(Observe)
    if observe not in known:
        missing = "" if "observe" in table else "; a table with another name needs the key observe"
        raise UserError(f"{where}: unknown arm {observe!r}; there are {', '.join(known)}{missing}")
    options = {key: value for key, value in table.items() if key not in ("name", "observe")}
    for key in options:
        if key in _OF_SCENARIO:
            raise UserError(f"{where}.{name}: {key} would let this arm play another environment; give it to a scenario")
    return StudyArm(name, observe, _task_options(options, f"{where}.{name}"))


def _scenario(name: str, table: Any, study: Study, where: str) -> Scenario:
    table = dict(converted(table, dict, where))
    _check_name(name, where)
    hints = get_type_hints(Scenario)
    own = {"env_id": name, "steps": study.steps, "num_envs": study.num_envs, "references": study.references}
    for key in own:
        if key in table:
            own[key] = converted(table.pop(key), hints[key], f"{where}: {key}")
    if own["references"] is None:
        own["references"] = MULTIAGENT_REFERENCES if is_multiagent_id(str(own["env_id"])) else REFERENCES
    options = _task_options(table, where, tuple(own))
    try:
        return Scenario(name=name, options=options, **own)  # type: ignore[arg-type]
    except UserError as error:
        raise UserError(f"{where}: {error}") from error


def _task_options(table: Mapping[str, Any], where: str, others: Sequence[str] = ("name", "observe")) -> dict[str, Any]:
    """Returns fields of `Task` from a table, converted to their types."""
    hints = get_type_hints(Task)
    known = [field.name for field in fields(Task) if field.name not in _OWN]
    for key in table:
        if key not in known:
            raise UserError(f"{where}: unknown key '{key}'; there are {', '.join((*others, *known))}")
    texts = dict(table)
    if isinstance(texts.get("env_kwargs"), dict):
        try:
            texts["env_kwargs"] = json.dumps(texts["env_kwargs"], sort_keys=True) if texts["env_kwargs"] else ""
        except TypeError as error:
            raise UserError(f"{where}: env_kwargs must hold what JSON has (no dates or times): {error}") from error
    return {key: converted(value, hints[key], f"{where}: {key}") for key, value in texts.items()}


def _check_name(name: str, where: str) -> None:
    if not name or not all(sign.isalnum() or sign in "-_" for sign in name):
        raise UserError(f"{where}: a name has letters, digits, - and _ alone, got '{name}'")
    if len(name) > LONGEST_NAME:
        raise UserError(f"{where}: a name is part of a folder's and has at most {LONGEST_NAME} signs, got {len(name)}")


def _filled(value: Any, places: Mapping[str, str]) -> Any:
    if not isinstance(value, str):
        return value
    for place in _PLACES:
        value = value.replace(f"{{{place}}}", places[place])
    return value
