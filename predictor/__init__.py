"""Trajectory predictors: the dG-VAE and baselines, their streaming form, training and data; torch without gymnasium.

    >>> from predictor import OnlineForecaster, load_forecaster

The names below are imported when they are used (`predictor.support.lazy_exports`).
"""

from typing import TYPE_CHECKING

from predictor.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from predictor.baselines.constant_velocity import ConstantVelocity
    from predictor.baselines.nearest_neighbour import NearestNeighbour
    from predictor.checkpoint import CheckpointInfo, load_checkpoint, load_forecaster, save_checkpoint
    from predictor.data.store import Episode, StoreInfo, read_store, write_store
    from predictor.dgvae import DGVAE, PRESETS, DGVAEConfig
    from predictor.forecaster import Belief, Forecaster, Futures, Memory, TrainableForecaster, edgeless_belief
    from predictor.online import OnlineForecaster
    from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
    from predictor.support.errors import ProtocolError, UserError
    from predictor.training.config import TrainConfig

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
        "predictor.online": ("OnlineForecaster",),
        "predictor.scene": ("Forecast", "Scene", "SceneBatch", "SceneSpec"),
        "predictor.training.config": ("TrainConfig",),
    },
)
