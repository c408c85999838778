"""Everything public of dgvae-rl under one name, which no folder of a user hides.

    >>> from dgvae_rl import ForecastObservation, make_env
    >>> env = ForecastObservation(make_env("highway-fast-v0"), "constant-velocity")

The packages `envs`, `predictor` and `agents` have generic names: a project that has an `envs/` of its own gets that one
when it writes `import envs`. The names here, and every module behind them (`dgvae_rl.envs.readers` is `envs.readers`),
work in such a project too (`dgvae_rl.own_packages`). They are imported when they are used.
"""

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from dgvae_rl.own_packages import install_finder

if TYPE_CHECKING:
    from agents import A2CPreset as A2CPreset
    from agents import AttentionConfig as AttentionConfig
    from agents import DQNPreset as DQNPreset
    from agents import Evaluation as Evaluation
    from agents import ForecastAttention as ForecastAttention
    from agents import PolicySummary as PolicySummary
    from agents import PPOPreset as PPOPreset
    from agents import QRDQNPreset as QRDQNPreset
    from agents import RecurrentPPOPreset as RecurrentPPOPreset
    from agents import SACPreset as SACPreset
    from agents import Task as Task
    from agents import TQCPreset as TQCPreset
    from agents import TrainedPolicy as TrainedPolicy
    from agents import TrainingPlan as TrainingPlan
    from agents import evaluate_policy_on_seeds as evaluate_policy_on_seeds
    from agents import load_model as load_model
    from agents import load_policy as load_policy
    from agents import policy_from_hub as policy_from_hub
    from agents import preset_for as preset_for
    from agents import push_policy_to_hub as push_policy_to_hub
    from agents import save_model as save_model
    from agents import train as train
    from envs import AgentMonitor as AgentMonitor
    from envs import AgentTensors as AgentTensors
    from envs import BatchedReader as BatchedReader
    from envs import EntityRowsReader as EntityRowsReader
    from envs import EnvPoolVecEnv as EnvPoolVecEnv
    from envs import FilmForecasts as FilmForecasts
    from envs import FilmParallelForecasts as FilmParallelForecasts
    from envs import ForecastConfig as ForecastConfig
    from envs import ForecastObservation as ForecastObservation
    from envs import ForecastParallelEnv as ForecastParallelEnv
    from envs import ForecastStream as ForecastStream
    from envs import FunctionReader as FunctionReader
    from envs import HighwayParallelEnv as HighwayParallelEnv
    from envs import MultiagentReader as MultiagentReader
    from envs import MultiagentScene as MultiagentScene
    from envs import ParallelVecEnv as ParallelVecEnv
    from envs import Reader as Reader
    from envs import SceneObservation as SceneObservation
    from envs import SceneReader as SceneReader
    from envs import SceneStream as SceneStream
    from envs import TensorReader as TensorReader
    from envs import VecForecast as VecForecast
    from envs import VectorForecast as VectorForecast
    from envs import View as View
    from envs import VmasReader as VmasReader
    from envs import agent_ids as agent_ids
    from envs import draw_observation as draw_observation
    from envs import make_env as make_env
    from envs import make_multiagent_env as make_multiagent_env
    from envs import pad_multiagent_scene as pad_multiagent_scene
    from envs import reader_for as reader_for
    from envs import register_reader as register_reader
    from envs import register_view as register_view
    from envs import unflatten as unflatten
    from predictor import DGVAE as DGVAE
    from predictor import PRESETS as PRESETS
    from predictor import Belief as Belief
    from predictor import CheckpointInfo as CheckpointInfo
    from predictor import ConstantVelocity as ConstantVelocity
    from predictor import DGVAEConfig as DGVAEConfig
    from predictor import Episode as Episode
    from predictor import Forecast as Forecast
    from predictor import Forecaster as Forecaster
    from predictor import Futures as Futures
    from predictor import Memory as Memory
    from predictor import NearestNeighbour as NearestNeighbour
    from predictor import OnlineForecaster as OnlineForecaster
    from predictor import ProtocolError as ProtocolError
    from predictor import Scene as Scene
    from predictor import SceneBatch as SceneBatch
    from predictor import SceneSpec as SceneSpec
    from predictor import StoreInfo as StoreInfo
    from predictor import TrainableForecaster as TrainableForecaster
    from predictor import TrainConfig as TrainConfig
    from predictor import UserError as UserError
    from predictor import edgeless_belief as edgeless_belief
    from predictor import from_hub as from_hub
    from predictor import load_checkpoint as load_checkpoint
    from predictor import load_forecaster as load_forecaster
    from predictor import push_to_hub as push_to_hub
    from predictor import read_store as read_store
    from predictor import save_checkpoint as save_checkpoint
    from predictor import write_store as write_store

install_finder()

PACKAGE_OF = {
    name: package
    for package, names in {
        "agents": (
            "A2CPreset", "AttentionConfig", "DQNPreset", "Evaluation", "ForecastAttention", "PPOPreset",
            "PolicySummary", "QRDQNPreset", "RecurrentPPOPreset", "SACPreset", "TQCPreset", "Task", "TrainedPolicy",
            "TrainingPlan", "evaluate_policy_on_seeds", "load_model", "load_policy", "policy_from_hub", "preset_for",
            "push_policy_to_hub", "save_model", "train",
        ),
        "envs": (
            "AgentMonitor", "AgentTensors", "BatchedReader", "EntityRowsReader", "EnvPoolVecEnv", "FilmForecasts",
            "FilmParallelForecasts", "ForecastConfig", "ForecastObservation", "ForecastParallelEnv", "ForecastStream",
            "FunctionReader", "HighwayParallelEnv", "MultiagentReader", "MultiagentScene", "ParallelVecEnv", "Reader",
            "SceneObservation", "SceneReader", "SceneStream", "TensorReader", "VecForecast", "VectorForecast", "View",
            "VmasReader", "agent_ids", "draw_observation", "make_env", "make_multiagent_env", "pad_multiagent_scene",
            "reader_for", "register_reader", "register_view", "unflatten",
        ),
        "predictor": (
            "Belief", "CheckpointInfo", "ConstantVelocity", "DGVAE", "DGVAEConfig", "Episode", "Forecast", "Forecaster",
            "Futures", "Memory", "NearestNeighbour", "OnlineForecaster", "PRESETS", "ProtocolError", "Scene",
            "SceneBatch", "SceneSpec", "StoreInfo", "TrainConfig", "TrainableForecaster", "UserError",
            "edgeless_belief", "from_hub", "load_checkpoint", "load_forecaster", "push_to_hub", "read_store",
            "save_checkpoint", "write_store",
        ),
    }.items()
    for name in names
}  # fmt: skip
"""Package of each public name."""

__all__ = sorted([*PACKAGE_OF, "__version__"])  # noqa: PLE0605

try:
    __version__ = version("dgvae-rl")
except PackageNotFoundError:  # a checkout that was never installed
    __version__ = "not installed"


def __getattr__(name: str) -> Any:
    """Imports the package of a public name and returns the name's value."""
    if name not in PACKAGE_OF:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{PACKAGE_OF[name]}"), name)
