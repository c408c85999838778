"""Environments that show a policy what other agents will do: readers, wrappers, collection, evaluation.

    >>> from envs import ForecastObservation, make_env
    >>> env = ForecastObservation(make_env("highway-fast-v0"))

The names below are imported when they are used: the wrappers for Gymnasium need neither PettingZoo, Stable-Baselines3
nor EnvPool; `ForecastParallelEnv` needs no Stable-Baselines3; the names of `envs.sb3` need it.
"""

from typing import TYPE_CHECKING

from predictor.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from envs.forecast_wrapper import unflatten
    from envs.parallel import ForecastParallelEnv
    from envs.readers import reader_for, register_reader
    from envs.readers.base import Reader, SceneReader
    from envs.readers.entities import EntityRowsReader
    from envs.readers.function import FunctionReader
    from envs.readers.identity import agent_ids
    from envs.registry import make_env, make_multiagent_env
    from envs.sb3.agents_as_rows import AgentMonitor, ParallelVecEnv
    from envs.sb3.envpool import EnvPoolVecEnv
    from envs.sb3.forecast import VecForecast
    from envs.simulators.highway_multiagent import HighwayParallelEnv
    from envs.vector import VectorForecast
    from envs.wrappers import ForecastObservation, SceneObservation

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "envs.forecast_wrapper": ("unflatten",),
        "envs.parallel": ("ForecastParallelEnv",),
        "envs.readers": ("reader_for", "register_reader"),
        "envs.readers.base": ("Reader", "SceneReader"),
        "envs.readers.entities": ("EntityRowsReader",),
        "envs.readers.function": ("FunctionReader",),
        "envs.readers.identity": ("agent_ids",),
        "envs.registry": ("make_env", "make_multiagent_env"),
        "envs.sb3.agents_as_rows": ("AgentMonitor", "ParallelVecEnv"),
        "envs.sb3.envpool": ("EnvPoolVecEnv",),
        "envs.sb3.forecast": ("VecForecast",),
        "envs.simulators.highway_multiagent": ("HighwayParallelEnv",),
        "envs.vector": ("VectorForecast",),
        "envs.wrappers": ("ForecastObservation", "SceneObservation"),
    },
)
