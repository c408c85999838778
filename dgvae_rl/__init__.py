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
    from agents import (
        A2CPreset,
        AttentionConfig,
        DQNPreset,
        Evaluation,
        ForecastAttention,
        PolicySummary,
        PPOPreset,
        QRDQNPreset,
        RecurrentPPOPreset,
        SACPreset,
        Task,
        TQCPreset,
        TrainedPolicy,
        TrainingPlan,
        evaluate_policy_on_seeds,
        load_model,
        load_policy,
        preset_for,
        save_model,
        train,
    )
    from envs import (
        AgentMonitor,
        EntityRowsReader,
        EnvPoolVecEnv,
        ForecastObservation,
        ForecastParallelEnv,
        FunctionReader,
        HighwayParallelEnv,
        ParallelVecEnv,
        Reader,
        SceneObservation,
        SceneReader,
        VecForecast,
        VectorForecast,
        agent_ids,
        make_env,
        make_multiagent_env,
        reader_for,
        register_reader,
        unflatten,
    )
    from predictor import (
        DGVAE,
        PRESETS,
        Belief,
        CheckpointInfo,
        ConstantVelocity,
        DGVAEConfig,
        Episode,
        Forecast,
        Forecaster,
        Futures,
        Memory,
        NearestNeighbour,
        OnlineForecaster,
        ProtocolError,
        Scene,
        SceneBatch,
        SceneSpec,
        StoreInfo,
        TrainableForecaster,
        TrainConfig,
        UserError,
        edgeless_belief,
        load_checkpoint,
        load_forecaster,
        read_store,
        save_checkpoint,
        write_store,
    )

install_finder()

PACKAGE_OF = {
    name: package
    for package, names in {
        "agents": (
            "A2CPreset", "AttentionConfig", "DQNPreset", "Evaluation", "ForecastAttention", "PPOPreset",
            "PolicySummary", "QRDQNPreset", "RecurrentPPOPreset", "SACPreset", "TQCPreset", "Task", "TrainedPolicy",
            "TrainingPlan", "evaluate_policy_on_seeds", "load_model", "load_policy", "preset_for", "save_model",
            "train",
        ),
        "envs": (
            "AgentMonitor", "EntityRowsReader", "EnvPoolVecEnv", "ForecastObservation", "ForecastParallelEnv",
            "FunctionReader", "HighwayParallelEnv", "ParallelVecEnv", "Reader", "SceneObservation", "SceneReader",
            "VecForecast", "VectorForecast", "agent_ids", "make_env", "make_multiagent_env", "reader_for",
            "register_reader", "unflatten",
        ),
        "predictor": (
            "Belief", "CheckpointInfo", "ConstantVelocity", "DGVAE", "DGVAEConfig", "Episode", "Forecast", "Forecaster",
            "Futures", "Memory", "NearestNeighbour", "OnlineForecaster", "PRESETS", "ProtocolError", "Scene",
            "SceneBatch", "SceneSpec", "StoreInfo", "TrainConfig", "TrainableForecaster", "UserError",
            "edgeless_belief", "load_checkpoint", "load_forecaster", "read_store", "save_checkpoint", "write_store",
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
