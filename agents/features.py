"""Features extractor of the policy's network: the ego attends over the agents around it.

Reads the Dict observation of `ForecastObservation` / `VecForecast`: the env's own observation (of a Dict, its entries,
flattened) becomes the ego's embedding (the query); each agent's state, futures with their probabilities and standard
deviations, edge probabilities, edge features and what happens in each candidate plan of the ego become a token (key,
value).
The features are the env's own observation, as a policy without forecasts gets it, and what the ego attends to, each
value times a learned gain that begins at 0. So learning begins as it does without forecasts, and forecasts add to that:
an untrained embedding in front of actor and critic is noise, which halved what simple_tag's predators learned.
The result does not depend on the order of agents, and padded agents (`valid` = 0) change nothing. A learned null token
is always present, so an empty scene works. It is not recurrent: only the forecaster keeps a history.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import gymnasium as gym
import torch
from jaxtyping import Bool, Float, Int
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn
from torch.nn import functional

from envs.own_observation import OWN_KEY, own_part
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

VALID_KEY = "valid"
WHAT_IF_GAP = "what_if_gap"
EGO_PATH = "ego_path"
CLOSEST = "closest"
TOKEN_KEYS = (
    *("agents", "forecast", CLOSEST, "mode_probs", "xy_scale", "edge_probs", "edge_features"),
    *(WHAT_IF_GAP, "what_if_contact", "what_if_risk"),
)
"""Entries of an observation that become tokens; of the other added ones only `EGO_PATH` and `VALID_KEY` are read. Those
without a scale here are of order one."""

NEAR, FAR, SPEED = 0.1, 0.5, 1.0
"""Scales for near positions, far positions and velocities, as fractions of a scene's `feature_scales`."""


@dataclass(frozen=True)
class AttentionConfig:
    """Sizes and input scales of `ForecastAttention`."""

    width: int = 64
    """Size of the ego's embedding, of a token and of the attended summary; the output also has the own observation."""
    hidden: int = 128
    """Number of hidden units of the embeddings."""
    heads: int = 4
    """Number of attention heads; must divide `width`."""
    near_m: float = 10.0
    """Scale of tanh(x / near_m), which resolves lanes and gaps and saturates far away [m]; default: for roads."""
    far_m: float = 50.0
    """Divisor of positions as second input, x / far_m, which does not saturate [m]."""
    speed_mps: float = 30.0
    """Divisor of relative velocities [m/s]; default: highway-env's top speed."""
    more_scales: tuple[float, ...] = ()
    """Divisor of each further feature of an agent (a height, a size); () leaves them as they are."""

    @classmethod
    def for_scenes(cls, spec: SceneSpec) -> "AttentionConfig":
        """Returns the scales that fit scenes of this layout: 10 m, 50 m and 30 m/s on roads, less in small arenas."""
        axes = spec.position_dim
        position_m, velocity_mps = max(spec.feature_scales[:axes]), max(spec.feature_scales[axes : 2 * axes])
        more = spec.feature_scales[2 * axes :]
        more = more if any(scale != 1 for scale in more) else ()
        return cls(near_m=NEAR * position_m, far_m=FAR * position_m, speed_mps=SPEED * velocity_mps, more_scales=more)

    def __post_init__(self) -> None:
        """Checks that the fields fit together.

        Raises:
            UserError: sizes or scales are not positive, or `heads` does not divide `width`.
        """
        if min(self.width, self.hidden, self.heads) < 1 or self.width % self.heads:
            raise UserError(f"width must be a multiple of heads, both positive, got {self.width} and {self.heads}")
        scales = (self.near_m, self.far_m, self.speed_mps, *self.more_scales)
        if min(scales) <= 0:
            raise UserError(f"scales must be positive, got {', '.join(map(str, scales))}")


def agents_there(valid: Float[Tensor, "batch agents"]) -> Bool[Tensor, "batch agents"]:
    """Returns which agents the entry `valid` says are there.

    Raises:
        UserError: it is neither 0 nor 1: a wrapper has scaled it, and agents would seem absent.
    """
    there = valid > 0.5
    if bool((there != valid).any()):
        raise UserError(
            "the entry valid must be 0 or 1: a wrapper has changed it; with VecNormalize, pass "
            "norm_obs_keys=['observation']"
        )
    return there


class ForecastAttention(BaseFeaturesExtractor):
    """SB3 features extractor for observations with forecasts; works with any subset of the token keys.

    Example:
        >>> from stable_baselines3 import PPO
        >>> from envs import ForecastObservation, make_env
        >>> env = ForecastObservation(make_env("highway-fast-v0"))
        >>> model = PPO("MultiInputPolicy", env, policy_kwargs={"features_extractor_class": ForecastAttention})

    Args:
        observation_space: Dict space with the environment's own keys (`observation`, or those of its Dict, which are
            flattened) and some of `agents`, `forecast`, `ego_path`, `closest`, `mode_probs`, `xy_scale`, `edge_probs`,
            `edge_features`, `what_if_gap`, `what_if_contact`, `what_if_risk`, `valid`.
        config: sizes and scales.
    """

    more_scales: Tensor

    def __init__(self, observation_space: gym.Space, config: AttentionConfig | None = None) -> None:
        """Makes the layers in the sizes of the space.

        Raises:
            UserError: the space is not a Dict, has no key of the environment's own, or entries of other shapes.
        """
        config = config or AttentionConfig()
        own = own_part(observation_space) if isinstance(observation_space, gym.spaces.Dict) else {}
        if not own or not isinstance(observation_space, gym.spaces.Dict):
            raise UserError(
                f"ForecastAttention needs a Dict with the key '{OWN_KEY}', or the environment's own keys, got "
                f"{observation_space}"
            )
        ego_dim = int(sum(get_flattened_obs_dim(space) for space in own.values()))  # NumPy's integer is none to torch
        super().__init__(observation_space, features_dim=ego_dim + config.width)
        self.config = config
        shapes = {k: space.shape or () for k, space in observation_space.items()}
        _check_shapes(shapes)
        self._own = tuple(own)
        self._keys = tuple(k for k in TOKEN_KEYS if k in shapes)
        self.ego = nn.Sequential(
            nn.Linear(ego_dim, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.width), nn.ReLU()
        )
        self.register_buffer("more_scales", torch.tensor(config.more_scales), persistent=False)
        further = shapes["agents"][-1] - 4 if "agents" in self._keys else 0
        if further and len(config.more_scales) not in (0, further):
            raise UserError(f"more_scales must be one for each of {further} further features, got {config.more_scales}")
        # A token depends on the ego: its first layer also gets the ego's embedding.
        token_dim = self._token_dim(shapes)
        self.token_in = nn.Linear(token_dim, config.hidden) if token_dim else None
        self.token_ego = nn.Linear(config.width, config.hidden, bias=False)
        self.token_out = nn.Sequential(nn.ReLU(), nn.Linear(config.hidden, config.width), nn.LayerNorm(config.width))
        self.null_token = nn.Parameter(torch.zeros(config.width))
        self.query = nn.Linear(config.width, config.width)
        self.key = nn.Linear(config.width, config.width)
        self.value = nn.Linear(config.width, config.width)
        self.attended = nn.Sequential(nn.Linear(config.width, config.width), nn.ReLU())
        self.gain = nn.Parameter(torch.zeros(config.width))

    def forward(self, observations: dict[str, Tensor]) -> Float[Tensor, "batch features"]:
        """Returns the env's own observation, concatenated with the weighted mean of what the ego attends to."""
        own = torch.cat([observations[key].flatten(1) for key in self._own], dim=-1)
        ego = self.ego(own)
        tokens, slots = self._tokens(ego, observations)
        return torch.cat([own, self.gain * self.attended(self._attend(ego, tokens, slots))], dim=-1)

    def _tokens(
        self, ego: Float[Tensor, "batch width"], observations: dict[str, Tensor]
    ) -> tuple[Float[Tensor, "tokens width"], Int[Tensor, "batch slots"]]:
        """Returns a token for each valid agent, the null token last; and for each ego, the tokens it attends to.

        Padding, which can be most of a scene, is left out before any layer.
        """
        null = self.null_token[None]
        if self.token_in is None:
            return null, torch.zeros(len(ego), 1, dtype=torch.long, device=ego.device)
        valid = self._valid(observations)
        env, slot = valid.nonzero(as_tuple=True)
        present = {k: observations[k][env, slot] for k in self._keys}
        if EGO_PATH in observations:
            present[EGO_PATH] = observations[EGO_PATH][env]
        inputs = self._token_inputs(present)
        # embedding() is indexing with a faster gradient
        of_ego = functional.embedding(env, functional.linear(ego, self.token_ego.weight, self.token_in.bias))
        tokens = self.token_out(torch.addmm(of_ego, inputs, self.token_in.weight.T))
        slots = torch.full((len(ego), valid.shape[1] + 1), len(env), device=ego.device)
        slots[env, slot] = torch.arange(len(env), device=ego.device)
        return torch.cat([tokens, null]), slots

    def _valid(self, observations: dict[str, Tensor]) -> Bool[Tensor, "batch agents"]:
        if VALID_KEY in observations:
            return agents_there(observations[VALID_KEY])
        agents = observations[self._keys[0]]
        return torch.ones(agents.shape[:2], dtype=torch.bool, device=agents.device)

    def _token_inputs(self, present: dict[str, Tensor]) -> Float[Tensor, "agents feature"]:
        """Returns the token keys of some agents, scaled to order one and concatenated."""
        parts: list[Tensor] = []
        if "agents" in self._keys:
            agents = present["agents"]
            more = agents[:, 4:] / self.more_scales if len(self.more_scales) else agents[:, 4:]
            parts += [self._squash(agents[:, :2]), agents[:, 2:4] / self.config.speed_mps, more]
        if "forecast" in self._keys:
            forecast = present["forecast"]  # agents [samples] horizon 2
            path = present.get(EGO_PATH)  # agents horizon 2
            if path is not None:  # where the ego is at the same time: what counts for a collision
                forecast = forecast - (path if forecast.ndim == 3 else path[:, None])
            parts.append(self._squash(forecast).flatten(1))
            forecast = present["forecast"]
            if "agents" in self._keys:
                now = present["agents"][:, :2]
                now = now.reshape(len(now), *(1,) * (forecast.ndim - 2), 2)
                parts.append(self._squash(forecast - now).flatten(1))
        if "xy_scale" in self._keys:
            parts.append(torch.tanh(present["xy_scale"] / self.config.near_m).flatten(1))
        if CLOSEST in self._keys:
            distance, time = present[CLOSEST].split(1, dim=-1)
            parts += [torch.tanh(distance / self.config.near_m), distance / self.config.far_m, time]
        if WHAT_IF_GAP in self._keys:
            gap = present[WHAT_IF_GAP]
            parts += [torch.tanh(gap / self.config.near_m), gap / self.config.far_m]
        scaled = ("agents", "forecast", CLOSEST, "xy_scale", WHAT_IF_GAP)
        parts += [present[k].flatten(1) for k in self._keys if k not in scaled]
        return torch.cat(parts, dim=-1)

    def _squash(self, metres: Float[Tensor, "*axes 2"]) -> Float[Tensor, "*axes 4"]:
        return torch.cat([torch.tanh(metres / self.config.near_m), metres / self.config.far_m], dim=-1)

    def _token_dim(self, shapes: dict[str, tuple[int, ...]]) -> int:
        """Returns the size of `_token_inputs`, measured on zeros."""
        if not self._keys:
            return 0
        empty = {k: torch.zeros(1, *shapes[k][1:]) for k in self._keys}
        if EGO_PATH in shapes:
            empty[EGO_PATH] = torch.zeros(1, *shapes[EGO_PATH])
        return self._token_inputs(empty).shape[-1]

    def _attend(
        self,
        ego: Float[Tensor, "batch width"],
        tokens: Float[Tensor, "tokens width"],
        slots: Int[Tensor, "batch slots"],
    ) -> Float[Tensor, "batch width"]:
        """Computes multi-head attention with one query, the ego.

        With one query, keys and values need not be made for each token: q · (K t) = (Kᵀ q) · t, and the mean of V t is
        V times the mean of t. The key's bias adds the same constant to all logits, which softmax cancels.
        """
        heads = self.config.heads
        query = self.query(ego).unflatten(-1, (heads, -1))
        key, value = (layer.weight.unflatten(0, (heads, -1)) for layer in (self.key, self.value))
        absent = slots == len(tokens) - 1
        absent[:, -1] = False  # the null token is always there
        seen = functional.embedding(slots, tokens)
        logits = seen @ torch.einsum("bhd,hdw->bwh", query / math.sqrt(query.shape[-1]), key)
        weights = logits.masked_fill(absent[..., None], -torch.inf).softmax(dim=1)
        attended = weights.transpose(1, 2) @ seen
        return torch.einsum("bhw,hdw->bhd", attended, value).flatten(1) + self.value.bias


def _check_shapes(shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raises a `UserError` where a wrapper has stacked or reshaped the entries."""
    plane = [key for key in ("forecast", EGO_PATH) if key in shapes and shapes[key][-1] != 2]
    slots = {shapes[key][0] for key in (*TOKEN_KEYS, VALID_KEY) if key in shapes}
    if plane or len(slots) > 1:
        raise UserError(
            "ForecastAttention needs the entries as the wrapper gives them, got "
            f"{', '.join(f'{key} {shape}' for key, shape in shapes.items())}; leave out what stacks or reshapes them "
            "(VecFrameStack): the forecaster keeps the history"
        )
