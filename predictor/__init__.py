"""Trajectory predictors: the dG-VAE and baselines, their streaming form, training and data; torch without gymnasium.

    >>> from predictor import OnlineForecaster, load_forecaster

The names below are imported when they are used (`predictor.support.lazy_exports`).
"""

from typing import TYPE_CHECKING

from predictor.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from predictor.baselines.constant_velocity import ConstantVelocity as ConstantVelocity
    from predictor.baselines.nearest_neighbour import NearestNeighbour as NearestNeighbour
    from predictor.checkpoint import CheckpointInfo as CheckpointInfo
    from predictor.checkpoint import load_checkpoint as load_checkpoint
    from predictor.checkpoint import load_forecaster as load_forecaster
    from predictor.checkpoint import save_checkpoint as save_checkpoint
    from predictor.data.store import Episode as Episode
    from predictor.data.store import StoreInfo as StoreInfo
    from predictor.data.store import read_store as read_store
    from predictor.data.store import write_store as write_store
    from predictor.dgvae import DGVAE as DGVAE
    from predictor.dgvae import PRESETS as PRESETS
    from predictor.dgvae import DGVAEConfig as DGVAEConfig
    from predictor.forecaster import Belief as Belief
    from predictor.forecaster import Forecaster as Forecaster
    from predictor.forecaster import Futures as Futures
    from predictor.forecaster import Memory as Memory
    from predictor.forecaster import TrainableForecaster as TrainableForecaster
    from predictor.forecaster import edgeless_belief as edgeless_belief
    from predictor.hub import from_hub as from_hub
    from predictor.hub import push_to_hub as push_to_hub
    from predictor.online import OnlineForecaster as OnlineForecaster
    from predictor.scene import Forecast as Forecast
    from predictor.scene import Scene as Scene
    from predictor.scene import SceneBatch as SceneBatch
    from predictor.scene import SceneSpec as SceneSpec
    from predictor.support.errors import ProtocolError as ProtocolError
    from predictor.support.errors import UserError as UserError
    from predictor.training.config import TrainConfig as TrainConfig

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "predictor.baselines.constant_velocity": ("ConstantVelocity",),
        "predictor.baselines.nearest_neighbour": ("NearestNeighbour",),
        "predictor.checkpoint": ("CheckpointInfo", "load_checkpoint", "load_forecaster", "save_checkpoint"),
        "predictor.data.store": ("Episode", "StoreInfo", "read_store", "write_store"),
        "predictor.dgvae": ("DGVAE", "DGVAEConfig", "PRESETS"),
        "predictor.support.errors": ("ProtocolError", "UserError"),
        "predictor.forecaster": (
            "Belief",
            "Forecaster",
            "Futures",
            "Memory",
            "TrainableForecaster",
            "edgeless_belief",
        ),
        "predictor.hub": ("from_hub", "push_to_hub"),
        "predictor.online": ("OnlineForecaster",),
        "predictor.scene": ("Forecast", "Scene", "SceneBatch", "SceneSpec"),
        "predictor.training.config": ("TrainConfig",),
    },
)
