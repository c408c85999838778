"""Policies that learn from forecasts, with Stable-Baselines3: features extractor, training, evaluation.

    >>> from agents import ForecastAttention, Task, TrainingPlan, load_policy, train

The names below are imported when they are used.
"""

from typing import TYPE_CHECKING

from predictor.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from agents.evaluate import evaluate_policy_on_seeds
    from agents.features import AttentionConfig, ForecastAttention
    from agents.policy import TrainedPolicy, load_policy
    from agents.presets import (
        A2CPreset,
        DQNPreset,
        PPOPreset,
        QRDQNPreset,
        RecurrentPPOPreset,
        SACPreset,
        TQCPreset,
        preset_for,
    )
    from agents.results import Evaluation
    from agents.runs import load_model, save_model
    from agents.summaries import PolicySummary
    from agents.task import Task
    from agents.training import TrainingPlan, train

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "agents.evaluate": ("evaluate_policy_on_seeds",),
        "agents.features": ("AttentionConfig", "ForecastAttention"),
        "agents.policy": ("TrainedPolicy", "load_policy"),
        "agents.presets": (
            "A2CPreset",
            "DQNPreset",
            "PPOPreset",
            "QRDQNPreset",
            "RecurrentPPOPreset",
            "SACPreset",
            "TQCPreset",
            "preset_for",
        ),
        "agents.results": ("Evaluation",),
        "agents.runs": ("load_model", "save_model"),
        "agents.summaries": ("PolicySummary",),
        "agents.task": ("Task",),
        "agents.training": ("TrainingPlan", "train"),
    },
)
