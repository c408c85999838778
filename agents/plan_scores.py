"""Policies that score each candidate plan of the ego by what the others would do in it.

An observation with `what_if` says, for each plan and agent, how close they come, when they touch, and how probable that
is. `PlanAttention` adds a summary of each plan to the features of `ForecastAttention`. `PlanScores` (PPO, A2C) and
`PlanValues` (DQN) give the plan's summary to one small network, the same for all plans, and add its score to the logit,
or the value, of the action with which the plan begins. A network that has learned once that a contact is bad then knows
it for every action.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch
from jaxtyping import Float
from stable_baselines3.common.policies import BasePolicy, MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.dqn.policies import MultiInputPolicy, QNetwork
from torch import Tensor, nn

from agents.features import VALID_KEY, WHAT_IF_GAP, AttentionConfig, ForecastAttention, agents_there
from agents.task import Task
from envs.plans import plan_model_for
from predictor.support.errors import UserError

CONTACT, RISK = "what_if_contact", "what_if_risk"
SUMMARY = 6
"""Number of values that summarise a plan."""
TOUCHING = 0.2
"""Scale of gaps that nearly touch, as a fraction of `AttentionConfig.near_m`: 2 m on roads."""
_HIDDEN = 32


def plan_actions(task: Task) -> tuple[int, ...] | None:
    """Returns the action with which each plan begins; None if actions are not numbers, or differ between states.

    Args:
        task: task whose observation has room for what-if forecasts.
    """
    env = task.make(disable_env_checker=True)
    env.close()
    if not isinstance(env.action_space, gym.spaces.Discrete):
        return None
    model = plan_model_for(env)
    actions: tuple[int, ...] | None = getattr(model, "actions", None)
    if actions is not None and not all(env.action_space.contains(action) for action in actions):
        raise UserError(f"{type(model).__name__}.actions must be actions of {env.action_space}, got {actions}")
    return actions


class PlanAttention(ForecastAttention):
    """`ForecastAttention` with a summary of each candidate plan behind its features.

    Args:
        observation_space: as for `ForecastAttention`, with the entries of `what_if`.
        config: sizes and scales.

    Attributes:
        num_plans: number of plans.
    """

    def __init__(self, observation_space: gym.Space, config: AttentionConfig | None = None) -> None:
        """Makes the layers in the sizes of the space.

        Raises:
            UserError: the space has no entries of `what_if`.
        """
        super().__init__(observation_space, config)
        assert isinstance(observation_space, gym.spaces.Dict)
        if WHAT_IF_GAP not in observation_space.spaces:
            raise UserError(f"PlanAttention needs the entry '{WHAT_IF_GAP}'; wrap the environment with what_if=True")
        others, self.num_plans = observation_space[WHAT_IF_GAP].shape or (0, 0)
        if not others:
            raise UserError(
                "PlanAttention needs room for another agent; wrap the environment with max_agents of 2 or more"
            )
        self._features_dim += SUMMARY * self.num_plans

    def forward(self, observations: dict[str, Tensor]) -> Float[Tensor, "batch features"]:
        """Returns the features of `ForecastAttention`, then `SUMMARY` values of each plan."""
        return torch.cat([super().forward(observations), self._summaries(observations).flatten(1)], dim=-1)

    def _summaries(self, observations: dict[str, Tensor]) -> Float[Tensor, "batch plans summary"]:
        """Returns smallest gap at three scales, first contact, largest risk and risk of any contact.

        Absent agents count as far away.
        """
        absent = ~agents_there(observations[VALID_KEY])[..., None]
        gap = observations[WHAT_IF_GAP].masked_fill(absent, 2 * self.config.far_m).amin(1)
        contact = observations[CONTACT].masked_fill(absent, 1.0).amin(1)
        risk = observations[RISK]
        any_contact = 1 - (1 - risk).prod(1)
        scales = (TOUCHING * self.config.near_m, self.config.near_m)
        gaps = [torch.tanh(gap / scale) for scale in scales] + [(gap / self.config.far_m).clamp(-1, 2)]
        return torch.stack([*gaps, contact, risk.amax(1), any_contact], dim=-1)


class _OverPlans(BasePolicy):
    """What both policies keep: the action with which each plan begins."""

    def __init__(self, *args: Any, plan_actions: Sequence[int], **kwargs: Any) -> None:
        """Makes the networks; `plan_actions` is the action with which each plan begins."""
        self.plan_actions = tuple(plan_actions)
        super().__init__(*args, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"plan_actions": self.plan_actions}


class PlanScores(_OverPlans, MultiInputActorCriticPolicy):
    """SB3 policy for `PlanAttention`: the logit of an action is that of SB3's actor, plus the score of its plan."""

    def _build_mlp_extractor(self) -> None:
        extractor = self.features_extractor
        assert isinstance(extractor, PlanAttention) and isinstance(self.action_space, gym.spaces.Discrete)
        super()._build_mlp_extractor()
        self.mlp_extractor: Any = _WithScores(self.mlp_extractor, extractor.num_plans, self.features_dim)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        extractor: Any = self.mlp_extractor
        # SB3 has made one layer from both; the scores go to their own actions instead
        self.action_net: nn.Module = _Logits(self.action_net, extractor.num_plans, self.plan_actions)
        assert self.optimizer_class is not None
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),
            **self.optimizer_kwargs,  # type: ignore[call-arg]
        )


class PlanValues(_OverPlans, MultiInputPolicy):
    """SB3 policy of DQN for `PlanAttention`: an action's value is that of SB3's network, plus the score of its plan."""

    def make_q_net(self) -> QNetwork:
        """Returns a network of values with the scores."""
        network = super().make_q_net()
        extractor = network.features_extractor
        assert isinstance(extractor, PlanAttention)
        values: Any = _Values(network.q_net, extractor.num_plans, network.features_dim, self.plan_actions)
        network.q_net = values
        return network.to(self.device)


class _Values(nn.Module):
    """Values of the actions: those of SB3's layers, plus the score of each action's plan."""

    def __init__(self, own: nn.Module, num_plans: int, features_dim: int, plan_actions: Sequence[int]) -> None:
        super().__init__()
        assert isinstance(own, nn.Sequential) and isinstance(own[-1], nn.Linear)
        self.own, self.score = own, _score_layers(num_plans, features_dim)
        self.places: Tensor
        self.register_buffer("places", _places(plan_actions, own[-1].out_features))

    def forward(self, features: Float[Tensor, "batch features"]) -> Float[Tensor, "batch actions"]:
        values: Tensor = self.own(features) + _scores(self.score, features, len(self.places)) @ self.places
        return values


class _WithScores(nn.Module):
    """Actor's and critic's hidden layers; the actor's end with the score of each plan."""

    def __init__(self, hidden: MlpExtractor, num_plans: int, features_dim: int) -> None:
        super().__init__()
        self.hidden, self.num_plans = hidden, num_plans
        self.latent_dim_pi = hidden.latent_dim_pi + num_plans
        self.latent_dim_vf = hidden.latent_dim_vf
        self.score = _score_layers(num_plans, features_dim)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Float[Tensor, "batch features"]) -> Float[Tensor, "batch latent"]:
        scores = _scores(self.score, features, self.num_plans)
        return torch.cat([self.hidden.forward_actor(features), scores], dim=-1)

    def forward_critic(self, features: Float[Tensor, "batch features"]) -> Float[Tensor, "batch latent"]:
        return self.hidden.forward_critic(features)


class _Logits(nn.Module):
    """Logits of the actions: a linear layer of the actor's hidden units, plus the score of each action's plan."""

    def __init__(self, both: nn.Module, num_plans: int, plan_actions: Sequence[int]) -> None:
        super().__init__()
        assert isinstance(both, nn.Linear)
        self.own = nn.Linear(both.in_features - num_plans, both.out_features)
        with torch.no_grad():
            self.own.weight.copy_(both.weight[:, :-num_plans])
            self.own.bias.copy_(both.bias)
        self.places: Tensor
        self.register_buffer("places", _places(plan_actions, both.out_features))

    def forward(self, latent: Float[Tensor, "batch latent"]) -> Float[Tensor, "batch actions"]:
        count = len(self.places)
        return self.own(latent[:, :-count]) + latent[:, -count:] @ self.places


def _score_layers(num_plans: int, features_dim: int) -> nn.Sequential:
    """Returns the network that scores a plan from the features of the scene and its summary."""
    inputs = features_dim - num_plans * SUMMARY + SUMMARY
    return nn.Sequential(nn.Linear(inputs, _HIDDEN), nn.Tanh(), nn.Linear(_HIDDEN, 1, bias=False))


def _scores(
    layers: nn.Module, features: Float[Tensor, "batch features"], num_plans: int
) -> Float[Tensor, "batch plans"]:
    """Computes the score of each plan from the features of `PlanAttention`."""
    context, summaries = features[:, : -num_plans * SUMMARY], features[:, -num_plans * SUMMARY :]
    each = torch.cat([context[:, None].expand(-1, num_plans, -1), summaries.unflatten(1, (num_plans, SUMMARY))], dim=-1)
    scores: Tensor = layers(each)[..., 0]
    return scores


def _places(plan_actions: Sequence[int], actions: int) -> Float[Tensor, "plans actions"]:
    """Returns 1 where a plan begins with an action, else 0."""
    places = torch.zeros(len(plan_actions), actions)
    places[torch.arange(len(plan_actions)), torch.tensor(plan_actions)] = 1.0
    return places
