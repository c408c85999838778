"""What the policy's network sees first: the ego attends over the agents around it.

Reads the Dict observation of `ForecastObservation` / `VecForecast`: the env's own observation becomes the ego's
embedding (the query); each agent's state, forecast, edge probabilities and edge features become a token (key, value).
The result does not depend on the order of agents, and padded rows (`valid` = 0) change nothing. A learned null token is
always present, so an empty scene works. Not recurrent: memory lives in the forecaster.
"""

import math
from dataclasses import dataclass

import gymnasium as gym
import torch
from jaxtyping import Bool, Float
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from predictor.errors import UserError

EGO_KEY = "observation"
VALID_KEY = "valid"
TOKEN_KEYS = ("agents", "forecast", "edge_probs", "edge_features")


@dataclass(frozen=True)
class AttentionConfig:
    """Size and input scaling of `ForecastAttention`."""

    width: int = 64
    """Size of the ego's embedding, of a token and of the attended summary; the output has twice this size."""
    hidden: int = 128
    """Hidden units of the embeddings."""
    heads: int = 4
    """Attention heads; must divide `width`."""
    near_m: float = 10.0
    """Positions enter once as tanh(x / near_m): resolves lanes and gaps, saturates far away [m]."""
    far_m: float = 50.0
    """… and once as x / far_m: keeps what is far in order of distance [m]."""
    speed_mps: float = 30.0
    """Divisor of relative velocities [m/s]; highway-env's top speed."""

    def __post_init__(self) -> None:
        """Check that the fields fit together."""
        if min(self.width, self.hidden, self.heads) < 1 or self.width % self.heads:
            raise UserError(f"width must be a multiple of heads, both positive, got {self.width} and {self.heads}")
        if min(self.near_m, self.far_m, self.speed_mps) <= 0:
            raise UserError(f"scales must be positive, got {self.near_m}, {self.far_m}, {self.speed_mps}")


class ForecastAttention(BaseFeaturesExtractor):
    """SB3 features extractor for forecast observations; works with any subset of the token keys.

    Example:
        >>> PPO("MultiInputPolicy", venv, policy_kwargs={"features_extractor_class": ForecastAttention})

    Args:
        observation_space: Dict space with `observation` and some of `agents`, `forecast`, `edge_probs`,
            `edge_features`, `valid`.
        config: sizes and scales.
    """

    def __init__(self, observation_space: gym.Space, config: AttentionConfig | None = None) -> None:
        """Size the layers from the space."""
        config = config or AttentionConfig()
        super().__init__(observation_space, features_dim=2 * config.width)
        if not isinstance(observation_space, gym.spaces.Dict) or EGO_KEY not in observation_space.spaces:
            raise UserError(f"ForecastAttention needs a Dict with the key '{EGO_KEY}', got {observation_space}")
        self.config = config
        shapes = {k: space.shape or () for k, space in observation_space.items()}
        self._keys = tuple(k for k in TOKEN_KEYS if k in shapes)
        ego_dim = get_flattened_obs_dim(observation_space[EGO_KEY])
        self.ego = nn.Sequential(
            nn.Linear(ego_dim, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.width), nn.ReLU()
        )
        # A token is read in the light of the ego: its first layer also gets the ego's embedding.
        token_dim = self._token_dim(shapes)
        self.token_in = nn.Linear(token_dim, config.hidden) if token_dim else None
        self.token_ego = nn.Linear(config.width, config.hidden, bias=False)
        self.token_out = nn.Sequential(nn.ReLU(), nn.Linear(config.hidden, config.width), nn.LayerNorm(config.width))
        self.null_token = nn.Parameter(torch.zeros(config.width))
        self.query = nn.Linear(config.width, config.width)
        self.key = nn.Linear(config.width, config.width)
        self.value = nn.Linear(config.width, config.width)
        self.attended = nn.Sequential(nn.Linear(config.width, config.width), nn.ReLU())

    def forward(self, observations: dict[str, Tensor]) -> Float[Tensor, "batch features"]:
        """The ego's embedding beside what it attends to."""
        ego = self.ego(observations[EGO_KEY].flatten(1))
        tokens, valid = self._tokens(ego, observations)
        return torch.cat([ego, self.attended(self._attend(ego, tokens, valid))], dim=-1)

    def _tokens(
        self, ego: Float[Tensor, "batch width"], observations: dict[str, Tensor]
    ) -> tuple[Float[Tensor, "batch tokens width"], Bool[Tensor, "batch tokens"]]:
        """One token per agent, the null token last."""
        batch = len(ego)
        null = self.null_token.expand(batch, 1, -1)
        present = torch.ones(batch, 1, dtype=torch.bool, device=ego.device)
        if self.token_in is None:
            return null, present
        inputs = self._token_inputs(observations)
        valid = torch.ones(inputs.shape[:2], dtype=torch.bool, device=ego.device)
        if VALID_KEY in observations:
            valid = observations[VALID_KEY] > 0.5
        inputs = inputs.masked_fill(~valid[..., None], 0.0)
        tokens = self.token_out(self.token_in(inputs) + self.token_ego(ego)[:, None])
        return torch.cat([tokens, null], dim=1), torch.cat([valid, present], dim=1)

    def _token_inputs(self, observations: dict[str, Tensor]) -> Float[Tensor, "batch agents feature"]:
        """The token keys, scaled to order one and concatenated per agent."""
        parts: list[Tensor] = []
        if "agents" in self._keys:
            agents = observations["agents"]
            parts += [self._squash(agents[..., :2]), agents[..., 2:4] / self.config.speed_mps, agents[..., 4:]]
        if "forecast" in self._keys:
            forecast = observations["forecast"]  # agents [samples] horizon 2
            parts.append(self._squash(forecast).flatten(2))
            if "agents" in self._keys:
                now = observations["agents"][..., :2]
                now = now.reshape(*now.shape[:2], *(1,) * (forecast.ndim - 3), 2)
                parts.append(self._squash(forecast - now).flatten(2))
        parts += [observations[k].flatten(2) for k in ("edge_probs", "edge_features") if k in self._keys]
        return torch.cat(parts, dim=-1)

    def _squash(self, metres: Float[Tensor, "*axes 2"]) -> Float[Tensor, "*axes 4"]:
        return torch.cat([torch.tanh(metres / self.config.near_m), metres / self.config.far_m], dim=-1)

    def _token_dim(self, shapes: dict[str, tuple[int, ...]]) -> int:
        """Size of `_token_inputs`, by running it on zeros."""
        if not self._keys:
            return 0
        return self._token_inputs({k: torch.zeros(1, *shapes[k]) for k in self._keys}).shape[-1]

    def _attend(
        self,
        ego: Float[Tensor, "batch width"],
        tokens: Float[Tensor, "batch tokens width"],
        valid: Bool[Tensor, "batch tokens"],
    ) -> Float[Tensor, "batch width"]:
        """Multi-head attention with one query, the ego."""
        heads = self.config.heads
        query = self.query(ego).unflatten(-1, (heads, -1))
        key = self.key(tokens).unflatten(-1, (heads, -1))
        value = self.value(tokens).unflatten(-1, (heads, -1))
        logits = torch.einsum("bhw,bthw->bht", query, key) / math.sqrt(query.shape[-1])
        weights = logits.masked_fill(~valid[:, None], -torch.inf).softmax(dim=-1)
        return torch.einsum("bht,bthw->bhw", weights, value).flatten(1)
