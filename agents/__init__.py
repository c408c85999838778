"""Policies that learn from forecasts, with Stable-Baselines3: features extractor, training, evaluation.

    >>> from agents import ForecastAttention, Task, TrainingPlan, load_policy, train

The names below are imported when they are used.
"""

from typing import TYPE_CHECKING

from predictor.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from agents.evaluate import evaluate_policy_on_seeds as evaluate_policy_on_seeds
    from agents.features import AttentionConfig as AttentionConfig
    from agents.features import ForecastAttention as ForecastAttention
    from agents.hub import policy_from_hub as policy_from_hub
    from agents.hub import push_policy_to_hub as push_policy_to_hub
    from agents.policy import TrainedPolicy as TrainedPolicy
    from agents.policy import load_policy as load_policy
    from agents.presets import A2CPreset as A2CPreset
    from agents.presets import DQNPreset as DQNPreset
    from agents.presets import PPOPreset as PPOPreset
    from agents.presets import QRDQNPreset as QRDQNPreset
    from agents.presets import RecurrentPPOPreset as RecurrentPPOPreset
    from agents.presets import SACPreset as SACPreset
    from agents.presets import TQCPreset as TQCPreset
    from agents.presets import preset_for as preset_for
    from agents.results import Evaluation as Evaluation
    from agents.runs import load_model as load_model
    from agents.runs import save_model as save_model
    from agents.summaries import PolicySummary as PolicySummary
    from agents.task import Task as Task
    from agents.training import TrainingPlan as TrainingPlan
    from agents.training import train as train

__getattr__, __all__ = lazy_exports(
    __name__,
    {
        "agents.evaluate": ("evaluate_policy_on_seeds",),
        "agents.features": ("AttentionConfig", "ForecastAttention"),
        "agents.hub": ("policy_from_hub", "push_policy_to_hub"),
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
