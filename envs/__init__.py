"""Environments that show a policy what other agents will do: readers, wrappers, collection, evaluation.

    >>> from envs import ForecastObservation, make_env
    >>> env = ForecastObservation(make_env("highway-fast-v0"))

The names below are imported when they are used: the wrappers for Gymnasium need neither PettingZoo, Stable-Baselines3
nor EnvPool; `ForecastParallelEnv` needs no Stable-Baselines3; the names of `envs.sb3` need it.
"""

from typing import TYPE_CHECKING

from predictor.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from envs.forecast_wrapper import unflatten as unflatten
    from envs.observation import ForecastStream as ForecastStream
    from envs.parallel import ForecastParallelEnv as ForecastParallelEnv
    from envs.readers import reader_for as reader_for
    from envs.readers import register_reader as register_reader
    from envs.readers.base import MultiagentReader as MultiagentReader
    from envs.readers.base import MultiagentScene as MultiagentScene
    from envs.readers.base import Reader as Reader
    from envs.readers.base import SceneReader as SceneReader
    from envs.readers.base import pad_multiagent_scene as pad_multiagent_scene
    from envs.readers.batched import AgentTensors as AgentTensors
    from envs.readers.batched import BatchedReader as BatchedReader
    from envs.readers.batched import TensorReader as TensorReader
    from envs.readers.entities import EntityRowsReader as EntityRowsReader
    from envs.readers.function import FunctionReader as FunctionReader
    from envs.readers.identity import agent_ids as agent_ids
    from envs.readers.vmas import VmasReader as VmasReader
    from envs.registry import make_env as make_env
    from envs.registry import make_multiagent_env as make_multiagent_env
    from envs.sb3.agents_as_rows import AgentMonitor as AgentMonitor
    from envs.sb3.agents_as_rows import ParallelVecEnv as ParallelVecEnv
    from envs.sb3.envpool import EnvPoolVecEnv as EnvPoolVecEnv
    from envs.sb3.forecast import VecForecast as VecForecast
    from envs.scene_stream import ForecastConfig as ForecastConfig
    from envs.scene_stream import SceneStream as SceneStream
    from envs.simulators.highway_multiagent import HighwayParallelEnv as HighwayParallelEnv
    from envs.vector import VectorForecast as VectorForecast
    from envs.video.drawing import View as View
    from envs.video.film_forecasts import FilmForecasts as FilmForecasts
    from envs.video.film_forecasts import register_view as register_view
    from envs.video.film_parallel import FilmParallelForecasts as FilmParallelForecasts
    from envs.video.seen import draw_observation as draw_observation
    from envs.wrappers import ForecastObservation as ForecastObservation
    from envs.wrappers import SceneObservation as SceneObservation

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "envs.forecast_wrapper": ("unflatten",),
        "envs.observation": ("ForecastStream",),
        "envs.parallel": ("ForecastParallelEnv",),
        "envs.readers": ("reader_for", "register_reader"),
        "envs.readers.base": ("MultiagentReader", "MultiagentScene", "Reader", "SceneReader", "pad_multiagent_scene"),
        "envs.readers.batched": ("AgentTensors", "BatchedReader", "TensorReader"),
        "envs.readers.entities": ("EntityRowsReader",),
        "envs.readers.function": ("FunctionReader",),
        "envs.readers.identity": ("agent_ids",),
        "envs.readers.vmas": ("VmasReader",),
        "envs.registry": ("make_env", "make_multiagent_env"),
        "envs.sb3.agents_as_rows": ("AgentMonitor", "ParallelVecEnv"),
        "envs.sb3.envpool": ("EnvPoolVecEnv",),
        "envs.sb3.forecast": ("VecForecast",),
        "envs.scene_stream": ("ForecastConfig", "SceneStream"),
        "envs.simulators.highway_multiagent": ("HighwayParallelEnv",),
        "envs.vector": ("VectorForecast",),
        "envs.video.drawing": ("View",),
        "envs.video.film_forecasts": ("FilmForecasts", "register_view"),
        "envs.video.film_parallel": ("FilmParallelForecasts",),
        "envs.video.seen": ("draw_observation",),
        "envs.wrappers": ("ForecastObservation", "SceneObservation"),
    },
)
