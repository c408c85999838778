"""Environments that are known by id: how each is made, its shipped checkpoint, its drivers and its learners.

Other ids that Gymnasium or PettingZoo has registered can be used too; no checkpoint ships for them.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from envs.readers.mpe import MPE_IDS
from envs.simulators.envpool import ENV_IDS as ENVPOOL_IDS
from envs.simulators.envpool import HIGHWAY_ENV_OF, known_tasks, register_envpool_ids
from envs.simulators.highway_settings import check_settings
from predictor.support.errors import UserError, named, short
from predictor.support.importing import CannotImportError, load_named
from predictor.support.reading import parse_json
from predictor.support.typed_values import converted

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

HEURISTIC_DRIVERS = ("heuristic", "mixed", "varied")
"""Drivers of the multiagent environments that `envs.drivers.all_agents` has a heuristic for."""
_EXAMPLE = """write '{"config": {"vehicles_count": 20}}'"""
_OF_GYMNASIUM = ("disable_env_checker", "render_mode")
"""Arguments of `make_env` that are not a user's."""
_REFUSALS = (TypeError, ValueError, AssertionError, ImportError)
"""What makers raise if they refuse their arguments or lack a package; any error counts, where a user gave arguments."""


@dataclass(frozen=True)
class EnvEntry:
    """Entry of one environment id."""

    factory: str | None = None
    """"module:function" that returns a PettingZoo ParallelEnv; None makes it with `gymnasium.make`."""
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the factory that belong to the id."""
    checkpoint: str | None = None
    """Name of the checkpoint under predictor/pretrained; None where none ships."""
    drivers: tuple[str, ...] = ("varied", "random", "idle")
    """Names of the drivers that take turns in data collection; the first one drives where accuracy is measured."""
    learners: tuple[str, ...] = ()
    """Roles that learn in train_policy.py unless --learners is given; empty where all agents do. Set where the sides
    are opponents: pursuers learn, against a prey that flees by rule."""

    @property
    def multiagent(self) -> bool:
        """Whether the id makes a PettingZoo environment."""
        return self.factory is not None


_HIGHWAY: dict[str, EnvEntry] = {
    "highway-v0": EnvEntry(checkpoint="highway"),
    "highway-fast-v0": EnvEntry(checkpoint="highway"),
    "two-way-v0": EnvEntry(checkpoint="two-way"),
    "merge-v1": EnvEntry(checkpoint="merge"),
    "merge-generic-v1": EnvEntry(checkpoint="merge-generic"),
    "roundabout-v1": EnvEntry(checkpoint="roundabout"),
    "roundabout-generic-v1": EnvEntry(checkpoint="roundabout-generic"),
    "intersection-v2": EnvEntry(checkpoint="intersection"),
    "exit-v1": EnvEntry(checkpoint="exit"),
    "racetrack-v1": EnvEntry(checkpoint="racetrack"),
    "racetrack-large-v1": EnvEntry(checkpoint="racetrack-large"),
    "racetrack-oval-v1": EnvEntry(checkpoint="racetrack-oval"),
    "u-turn-v1": EnvEntry(checkpoint="u-turn"),
    "highway-mixed-v0": EnvEntry(checkpoint="highway-mixed"),
    "merge-mixed-v0": EnvEntry(checkpoint="merge-mixed"),
    "roundabout-mixed-v0": EnvEntry(checkpoint="roundabout-mixed"),
    "intersection-mixed-v0": EnvEntry(checkpoint="intersection-mixed"),
}
"""highway-env's ids, and those of `envs.simulators.mixed_traffic`."""


def _original_of(env_id: str) -> EnvEntry:
    """Returns the entry of the highway-env id, of any version, that an EnvPool id re-implements."""
    name = HIGHWAY_ENV_OF[ENVPOOL_IDS[env_id]].rpartition("-v")[0]
    return next((entry for known, entry in _HIGHWAY.items() if known.rpartition("-v")[0] == name), EnvEntry())


def _mpe(env_id: str, checkpoint: str | None = None, learners: tuple[str, ...] = ()) -> EnvEntry:
    return EnvEntry(f"mpe2.{env_id}:parallel_env", {}, checkpoint, HEURISTIC_DRIVERS, learners)


def _intersection(env_id: str, checkpoint: str | None = None) -> EnvEntry:
    return EnvEntry(f"{__package__}.simulators.highway_multiagent:HighwayParallelEnv", {"env_id": env_id}, checkpoint)


ENVS: dict[str, EnvEntry] = {
    **_HIGHWAY,
    "highway-mixed-costly-v0": EnvEntry(checkpoint="highway-mixed"),  # other rewards, the same traffic
    "intersection-costly-v0": EnvEntry(checkpoint="intersection"),
    **{
        env_id: EnvEntry(checkpoint=_original_of(env_id).checkpoint)
        for env_id, task in ENVPOOL_IDS.items()
        if task in known_tasks()
    },
    **{env_id: _mpe(env_id, "particles") for env_id in MPE_IDS},
    "collect_treasure_v1": _mpe("collect_treasure_v1"),
    "simple_tag_v3": _mpe("simple_tag_v3", "simple-tag", learners=("adversary",)),
    "simple_spread_v3": _mpe("simple_spread_v3", "simple-spread"),
    "simple_world_comm_v3": _mpe("simple_world_comm_v3", "particles", learners=("adversary",)),
    "pursuit_v5": EnvEntry("pettingzoo.sisl.pursuit.pursuit:parallel_env", drivers=HEURISTIC_DRIVERS),
    "intersection-multi-agent-v2": _intersection("intersection-multi-agent-v2", "intersection"),
    "intersection-multi-agent-v1": _intersection("intersection-multi-agent-v1"),
    "intersection-multi-agent-v0": _intersection("intersection-multi-agent-v0"),
}
"""Id → its entry. mpe2's simple_crypto is left out: nothing moves in it."""

MULTIAGENT_IDS = tuple(env_id for env_id, entry in ENVS.items() if entry.multiagent)
"""Ids of `ENVS` that make PettingZoo environments."""
CHECKPOINTS: dict[str, str] = {
    env_id: entry.checkpoint for env_id, entry in ENVS.items() if entry.checkpoint and env_id in _HIGHWAY
}
"""Gymnasium id → name of its checkpoint; EnvPool's copies and ids with other rewards have that of their original."""
MULTIAGENT_CHECKPOINTS: dict[str, str] = {
    env_id: entry.checkpoint for env_id, entry in ENVS.items() if entry.checkpoint and entry.multiagent
}
"""PettingZoo id → name of its checkpoint."""


def entry_for(env_id: str) -> EnvEntry:
    """Returns the entry of an id; of one that is not listed, an entry without a checkpoint."""
    return ENVS.get(env_id, EnvEntry())


def is_foreign_id(env_id: str) -> bool:
    """Returns whether an id is neither listed here nor of highway-env; imports no module that the id names."""
    import highway_env  # noqa: F401  (registers its ids)

    if env_id in ENVS:
        return False
    spec = gym.registry.get(env_id.rpartition(":")[2])
    return spec is None or not str(spec.entry_point).startswith("highway_env.")


def arguments_of(text: str) -> dict[str, Any]:
    """Returns the arguments of an environment that `--env-kwargs` holds.

    Args:
        text: text of a JSON object; empty for none.

    Raises:
        UserError: it is no JSON object, or holds the id or what commands set by themselves.
    """
    try:
        kwargs = parse_json(text or "{}", "env_kwargs")
    except UserError as error:
        why = str(error).removesuffix("; get it anew")
        raise UserError(f"env_kwargs must be a JSON object, got {short(repr(text))}: {why}; {_EXAMPLE}") from error
    if not isinstance(kwargs, dict):
        raise UserError(f"env_kwargs must be a JSON object, got {short(repr(text))}; {_EXAMPLE}")
    if "env_id" in kwargs or "id" in kwargs:
        raise UserError("env_kwargs are arguments of the environment and cannot hold its env_id; leave it out")
    for name in _OF_GYMNASIUM:
        if name in kwargs:
            raise UserError(f"env_kwargs cannot hold {name}, which each command sets by itself; leave it out")
    return kwargs


def check_arguments(text: Any, where: str) -> None:
    """Checks arguments of an environment that a file holds; see `arguments_of`.

    Raises:
        UserError: they are no such text; the message begins with `where`.
    """
    try:
        arguments_of(converted(text, str, "env_kwargs"))
    except UserError as error:
        raise UserError(f"{where}: {error}") from error


def name_with(env_id: str, env_kwargs: str) -> str:
    """Returns an id with the arguments of its environment, for tables and messages: `merge-v1 {"size": 3}`."""
    return f"{env_id} {env_kwargs}" if arguments_of(env_kwargs) else env_id


def make_env(env_id: str, **kwargs: Any) -> gym.Env:
    """Makes a Gymnasium environment.

    Args:
        env_id: id of highway-env, of `envs.simulators`, of EnvPool ("envpool/Highway-v0"), or any other
            that Gymnasium knows.
        kwargs: for `gymnasium.make`.

    Raises:
        UserError: unknown id, a missing package, arguments that the environment refuses, or a `config` with a setting
            that highway-env's does not have.
    """
    import highway_env  # noqa: F401  (registers its ids)

    from envs.simulators import costly_collisions, mixed_traffic  # noqa: F401  (register their ids)
    from envs.simulators.idm_constants import restore_idm_constants

    register_envpool_ids()
    module, colon, _ = env_id.partition(":")
    if colon and not all(part.isidentifier() for part in module.split(".")):
        raise UserError(f"cannot make env '{short(env_id)}': '{short(module)}' before the colon is no name of a module")
    mode = kwargs.get("render_mode")
    if not isinstance(mode, str | None):
        raise UserError(f"cannot make env '{env_id}': render_mode must be a text, got {short(mode)}")
    try:
        env = gym.make(env_id, **kwargs)
        restore_idm_constants(env)
        if isinstance(config := kwargs.get("config"), Mapping):
            check_settings(env, config)
        return env
    except UserError:
        raise
    except (gym.error.Error, ImportError) as error:
        own = f"'{module}' has no such function or class, either; " if colon else f"give your own as module:{env_id}; "
        raise UserError(f"cannot make env '{env_id}': {error}; {own}known here: {', '.join(_HIGHWAY)}") from error
    except Exception as error:
        given = {name: value for name, value in kwargs.items() if name not in _OF_GYMNASIUM}
        if given:
            raise UserError(f"cannot make env '{short(env_id)}' with {short(given)}: {named(error)}") from error
        if not colon:
            raise
        raise UserError(f"cannot make env '{short(env_id)}': {named(error)}") from error


def make_multiagent_env(env_id: str, **kwargs: Any) -> "ParallelEnv":
    """Makes a PettingZoo environment.

    Args:
        env_id: one of `MULTIAGENT_IDS`, an id in PettingZoo's own registry ("sisl/pursuit_v5"), or "module:function" of
            a function (or class) that returns a ParallelEnv.
        kwargs: for the environment (``max_cycles``, ``continuous_actions``, …).

    Raises:
        UserError: unknown id, a missing package, or arguments that the environment refuses.
    """
    from pettingzoo import ParallelEnv
    from pettingzoo.env_registry.exceptions import PettingZooRegistryError

    make = _maker(env_id)
    try:
        env = make(**kwargs)
    except UserError:
        raise
    except Exception as error:
        expected = isinstance(error, (*_REFUSALS, PettingZooRegistryError))
        if not kwargs and not expected:
            raise
        arguments = f" with {short(kwargs)}" if kwargs else ""
        reason = error if expected else named(error)
        raise UserError(f"cannot make multiagent env '{env_id}'{arguments}: {reason}") from error
    if not isinstance(env, ParallelEnv):
        raise UserError(f"'{env_id}' must give a pettingzoo ParallelEnv, got {type(env).__name__}")
    return env


def make_any_env(env_id: str, **kwargs: Any) -> Any:
    """Makes an environment of either kind: of an id, or of "module:function" (or a class), whichever it returns.

    Args:
        env_id: as `make_env` and `make_multiagent_env` take it; a function may return a Gymnasium environment, too.
        kwargs: for the environment.

    Raises:
        UserError: unknown id, a missing package, or arguments that the environment refuses.
    """
    make = _function_named(env_id)
    if make is None:
        return make_multiagent_env(env_id, **kwargs) if is_multiagent_id(env_id) else make_env(env_id, **kwargs)
    from pettingzoo import ParallelEnv

    try:
        env = make(**kwargs)
    except UserError:
        raise
    except Exception as error:
        if not kwargs and not isinstance(error, _REFUSALS):
            raise
        raise UserError(f"cannot make env '{env_id}': {named(error)}") from error
    if not isinstance(env, gym.Env | ParallelEnv):
        raise UserError(f"'{env_id}' must give a gymnasium Env or a pettingzoo ParallelEnv, got {type(env).__name__}")
    return env


def _function_named(env_id: str) -> Callable[..., Any] | None:
    """Returns the function that "module:function" names; None if it is an id, "module:Id" included.

    Raises:
        UserError: the module cannot be imported.
    """
    if ":" not in env_id:
        return None
    try:
        return load_named(env_id)
    except CannotImportError:
        raise
    except UserError:
        return None


def is_multiagent_id(env_id: str) -> bool:
    """Returns whether `make_multiagent_env` knows the id: listed here, "module:function", or PettingZoo's.

    The module of a "module:function" is imported; gymnasium's "module:EnvId" is none of these.
    """
    if env_id in ENVS:
        return ENVS[env_id].multiagent
    if ":" not in env_id:
        return _in_pettingzoo(env_id)
    from pettingzoo import ParallelEnv

    try:
        factory = load_named(env_id)
    except CannotImportError as error:
        if isinstance(error.__cause__, SystemExit):  # importing it again would end this process
            raise
        return False
    except UserError:
        return False
    return not isinstance(factory, type) or issubclass(factory, ParallelEnv)


def require_multiagent(env_id: str, options: str, purpose: str) -> None:
    """Checks that an id is one of `is_multiagent_id`, for options that other environments do not have.

    Args:
        env_id: id of an environment.
        options: name of the options, for the message.
        purpose: what they do there, which follows the name.

    Raises:
        UserError: it is another one, or its module cannot be imported.
    """
    if is_multiagent_id(env_id):
        return
    if ":" in env_id:
        try:
            load_named(env_id)
        except UserError as error:
            if error.__cause__ is not None:  # the module is the trouble, not what is in it
                raise
    raise UserError(f"{options} {purpose}, {env_id} has one ego; leave {options} out")


def checkpoint_for(env_id: str) -> str:
    """Returns the name of the checkpoint that ships for an id, of Gymnasium or PettingZoo.

    Raises:
        UserError: none ships for the id.
    """
    checkpoint = entry_for(env_id).checkpoint
    if checkpoint is None:
        raise UserError(
            f"no checkpoint ships for env '{env_id}'; pass one (--checkpoint NAME or PATH), or 'constant-velocity'. "
            f"Shipped ids: {', '.join((*CHECKPOINTS, *MULTIAGENT_CHECKPOINTS))}"
        )
    return checkpoint


def envpool_task_of(env_id: str) -> str:
    """Returns the EnvPool task that re-implements a highway-env id: its own version, else the first that EnvPool has.

    Raises:
        UserError: EnvPool has none.
    """
    copies = {task: HIGHWAY_ENV_OF[task] for task in known_tasks()}
    exact = [task for task, copied in copies.items() if copied == env_id]
    near = [task for task, copied in copies.items() if copied.rpartition("-v")[0] == env_id.rpartition("-v")[0]]
    if not exact + near:
        raise UserError(
            f"EnvPool has no copy of '{env_id}'; it has {', '.join(copies.values())}: train without --backend envpool"
        )
    return (exact + near)[0]


def _maker(env_id: str) -> Callable[..., Any]:
    entry = entry_for(env_id)
    if entry.factory is not None:
        return functools.partial(load_named(entry.factory), **entry.kwargs)
    if ":" in env_id:
        return load_named(env_id)
    if _in_pettingzoo(env_id):
        import pettingzoo

        return functools.partial(pettingzoo.make, "parallel", env_id)
    raise UserError(
        f"unknown multiagent env '{env_id}'; known: {', '.join(MULTIAGENT_IDS)}; others as 'module:function' or "
        "registered with pettingzoo.register('parallel', id, ...)"
    )


def _in_pettingzoo(env_id: str) -> bool:
    import pettingzoo
    from pettingzoo.env_registry.exceptions import PettingZooRegistryError

    try:
        pettingzoo.spec("parallel", env_id)
    except PettingZooRegistryError:
        return False
    return True
