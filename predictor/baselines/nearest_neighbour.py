"""Nearest neighbours: each agent moves as the k most similar recorded agents did, without interaction.

Similarity is that of position, velocity, position relative to the ego, and role. Nothing is trained and there is no
memory; examples are kept as they are. It is no baseline of the paper, and it is not saved as a checkpoint: it is fitted
to an episode store when it is needed, which takes seconds.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from predictor.data.store import Episode, read_store
from predictor.data.windows import foreseeable, visible
from predictor.forecaster import Belief, Futures, Memory, edgeless_belief
from predictor.noise import Noise
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

K = 5
"""Number of neighbours that a forecast averages."""
MAX_EXAMPLES = 200_000
"""Largest number of examples: a step then takes a few milliseconds on a CPU core."""
ROLE_WEIGHT = 10.0
"""Weight of constant features, so that an agent of another role is far away."""
LEAST_SPREAD = 1e-3
"""Smallest spread that a feature is divided by, in units of its `feature_scales`, so that noise is not magnified."""
BLOCK = 64
"""Number of examples in a block; the search compares blocks first."""
MAX_QUERIES = 64
"""Largest number of queries that are searched at once."""
MAX_DISTANCES = 2**17
"""Largest number of distances in memory at once: 1 MB, which fits into a cache."""


class Examples(NamedTuple):
    """Features of recorded agents at some instant, and their motion after it."""

    features: Float[Tensor, "examples features"]
    """Features of each example, by `query_features`."""
    displacements: Float[Tensor, "examples horizon axes"]
    """Position at each of the next steps, minus the position at the instant [m]."""


class NearestNeighbour(nn.Module):
    """Forecaster without memory and without edges, made of examples; `fit` collects them.

    Args:
        spec: layout of the scenes.
        examples: examples, at least one; if fewer than `k`, all of them are averaged.
        k: number of neighbours to average.

    Raises:
        UserError: there are no examples or no steps, or `k` is below 1.
    """

    num_edge_types = 2
    edge_feature_dim = 1

    def __init__(self, spec: SceneSpec, examples: Examples, k: int = K) -> None:
        """Scales the examples and arranges them in blocks."""
        super().__init__()
        count, horizon_steps, _ = examples.displacements.shape
        if count < 1 or horizon_steps < 1 or k < 1:
            raise UserError(
                f"nearest neighbours need examples, steps and k of at least 1, got {count}, {horizon_steps} and {k}"
            )
        self.spec = spec
        self.horizon_steps = horizon_steps
        self.k = min(k, count)
        self.num_examples = count
        features = examples.features.double()
        centre, scales = features.median(0).values, feature_scales(spec, features)
        points = (features - centre) / scales
        padding = points.new_zeros(-count % BLOCK, points.shape[1])
        self.points: Tensor
        self.centre: Tensor
        self.scales: Tensor
        self.displacements: Tensor
        self._doubled: Tensor
        self._squares: Tensor
        for name, tensor in (
            ("points", torch.cat([points, padding])),
            ("centre", centre),
            ("scales", scales),
            ("displacements", examples.displacements.float()),
            ("_doubled", torch.cat([-2 * points, padding]).T.contiguous()),
            ("_squares", torch.cat([points.square().sum(1), padding.new_full((len(padding),), torch.inf)])),
        ):
            self.register_buffer(name, tensor, persistent=False)

    @classmethod
    def fit(
        cls,
        episodes: Sequence[Episode],
        spec: SceneSpec,
        horizon_steps: int,
        k: int = K,
        max_examples: int = MAX_EXAMPLES,
        seed: int = 0,
    ) -> "NearestNeighbour":
        """Fits a forecaster of up to `horizon_steps` steps to recorded episodes; see `collect_examples`.

        Raises:
            UserError: no agent of the episodes has a future of that length, or a number is below 1.
        """
        examples = collect_examples(episodes, spec, horizon_steps, max_examples, seed)
        return cls(spec, examples, k)

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Returns a memory without content."""
        return Memory()

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Returns the states as belief; every pair has "no edge"."""
        return memory, edgeless_belief(states, valid, self.num_edge_types, self.edge_feature_dim)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Computes sample 0 from the mean motion of the neighbours, sample s from the s-th nearest one, cyclically.

        Velocities are finite differences of positions; other features are constant. Nothing is drawn. Absent agents
        are zeros.

        Raises:
            UserError: `horizon_steps` is larger than the fitted one.
        """
        if horizon_steps > self.horizon_steps:
            raise UserError(
                f"nearest neighbours were fitted to horizon_steps={self.horizon_steps} but {horizon_steps} steps were "
                f"asked for; fit them with horizon_steps={horizon_steps}"
            )
        states, valid, axes = belief.states, belief.valid, self.spec.position_dim
        neighbours, _ = self.nearest(query_features(self.spec, states, valid)[valid])
        single = self.displacements[neighbours].to(states.dtype)
        order = torch.arange(num_samples - 1, device=states.device) % self.k
        moved = torch.cat([single.mean(1, keepdim=True), single[:, order]], dim=1)
        steps = moved.diff(dim=2, prepend=torch.zeros_like(moved[:, :, :1]))[:, :, :horizon_steps]
        now = states[valid]
        future = now[:, None, None].repeat(1, num_samples, horizon_steps, 1)
        future[..., :axes] += moved[:, :, :horizon_steps]
        future[..., axes : 2 * axes] = steps / self.spec.dt_s
        all_agents = states.new_zeros(*valid.shape, num_samples, horizon_steps, states.shape[-1])
        all_agents[valid] = future
        return Futures(all_agents.transpose(1, 2))

    def nearest(
        self, features: Float[Tensor, "queries features"]
    ) -> tuple[Int[Tensor, "queries k"], Float[Tensor, "queries k"]]:
        """Finds the indices of the k nearest examples, nearest first, and their distances in spreads.

        The k nearest lie in the k blocks of examples whose nearest member is nearest, so only those are sorted.

        Args:
            features: features by `query_features`.
        """
        queries = (features.to(self.points.dtype) - self.centre) / self.scales
        found = [self._nearest(part) for part in queries.split(MAX_QUERIES)]
        return torch.cat([index for index, _ in found]), torch.cat([distance for _, distance in found])

    def _nearest(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        width = max(1, MAX_DISTANCES // BLOCK // max(1, len(queries))) * BLOCK
        examples = zip(self._squares.split(width), self._doubled.split(width, dim=1), strict=True)
        # |x − q|² − |q|² as a product; float64, because float32 would take near examples for equal ones
        parts = [torch.addmm(x2, queries, x).unflatten(1, (-1, BLOCK)).amin(2) for x2, x in examples]
        first = torch.cat(parts, dim=1)
        blocks = first.topk(min(self.k, first.shape[1]), largest=False).indices
        index = (blocks[:, :, None] * BLOCK + torch.arange(BLOCK, device=queries.device)).flatten(1)
        squared = (self.points[index] - queries[:, None]).square().sum(-1)
        squared = torch.where(index < self.num_examples, squared, torch.inf)
        nearest = squared.topk(self.k, largest=False)
        return index.gather(1, nearest.indices), nearest.values.sqrt()


def query_features(
    spec: SceneSpec, states: Float[Tensor, "*batch agents state"], valid: Bool[Tensor, "*batch agents"]
) -> Float[Tensor, "*batch agents features"]:
    """Computes the compared features: position, velocity, position relative to the ego, constant features [SI].

    Positions are in the world on "world" axes, relative to the mean of all agents on "centroid" axes, and left out on
    "ego" axes. Positions relative to the ego are included if the spec has an ego, and zero while the ego is absent.
    Absent agents are zeros.
    """
    axes = spec.position_dim
    positions, present = states[..., :axes], valid[..., None]
    total = torch.where(present, positions, 0.0).sum(-2, keepdim=True)
    mean = total / present.sum(-2, keepdim=True).clamp(min=1)
    centre = mean * mean.new_tensor([float(f == "centroid") for f in spec.frame])
    placed = [axis for axis, f in enumerate(spec.frame) if f != "ego"]
    columns = [(positions - centre)[..., placed], states[..., axes : 2 * axes]]
    if spec.has_ego:
        columns.append(torch.where(present[..., :1, :], positions - positions[..., :1, :], 0.0))
    columns.append(states[..., [spec.feature_names.index(name) for name in spec.constant_features]])
    return torch.where(present, torch.cat(columns, dim=-1), 0.0)


def feature_scales(spec: SceneSpec, features: Float[Tensor, "examples features"]) -> Float[Tensor, " features"]:
    """Computes the divisor of each feature: its mean absolute deviation from the median over the examples.

    Outliers thus have little weight, and the few examples that differ in a nearly constant feature are far from the
    others. Constant features are divided by a tenth of that (`ROLE_WEIGHT`). No spread is below `LEAST_SPREAD` of the
    spec's scale.
    """
    axes, scales = spec.position_dim, spec.feature_scales
    least = [scales[axis] for axis, f in enumerate(spec.frame) if f != "ego"]
    least += [*scales[axes : 2 * axes], *(scales[:axes] if spec.has_ego else ())]
    least += [scales[spec.feature_names.index(name)] for name in spec.constant_features]
    weights = features.new_ones(len(least))
    weights[len(least) - len(spec.constant_features) :] = ROLE_WEIGHT
    spread = (features - features.median(0).values).abs().mean(0)
    return torch.maximum(spread, LEAST_SPREAD * features.new_tensor(least)) / weights


def collect_examples(
    episodes: Sequence[Episode],
    spec: SceneSpec,
    horizon_steps: int,
    max_examples: int = MAX_EXAMPLES,
    seed: int = 0,
) -> Examples:
    """Collects each agent at each step at which it is perceived and after which it is present for the whole horizon.

    The ego (agent 0, if the spec has one) is no example: its future is the policy's choice. While the ego is absent
    there are no examples, since no agent is perceived.

    Args:
        episodes: recorded episodes, with all agents.
        spec: layout that decides which agents are perceived and which features are compared.
        horizon_steps: number of steps of the future.
        max_examples: largest number of examples; of more, this many are drawn.
        seed: random seed of that draw.

    Raises:
        UserError: there is no example, or a number is below 1.
    """
    if horizon_steps < 1 or max_examples < 1:
        raise UserError(f"horizon_steps and max_examples must be at least 1, got {horizon_steps} and {max_examples}")
    seen = [visible(e, spec) if e.valid.shape[1] else e.valid for e in episodes]
    who = [np.argwhere(_complete(e, s, spec, horizon_steps)) for e, s in zip(episodes, seen, strict=True)]
    count = sum(map(len, who))
    if not count:
        longest = max((len(e.states) for e in episodes), default=0)
        raise UserError(
            f"nearest neighbours need an agent{' other than the ego' * spec.has_ego} that is perceived and then there "
            f"for horizon_steps={horizon_steps}, but {len(episodes)} episodes of at most {longest} steps have none; "
            "lower horizon_steps or record longer episodes"
        )
    kept = np.ones(count, dtype=np.bool_)
    kept[np.random.default_rng(seed).permutation(count)[max_examples:]] = False
    parts = np.split(kept, np.cumsum([len(pairs) for pairs in who])[:-1])
    found = [
        _examples(e, s, pairs[part], spec, horizon_steps)
        for e, s, pairs, part in zip(episodes, seen, who, parts, strict=True)
        if part.any()
    ]
    return Examples(*(torch.cat(tensors) for tensors in zip(*found, strict=True)))


def fit_from_stores(
    paths: Sequence[Path],
    spec: SceneSpec,
    horizon_steps: int,
    source: str = "the scene",
    k: int = K,
    max_examples: int = MAX_EXAMPLES,
    seed: int = 0,
) -> NearestNeighbour:
    """Fits nearest neighbours for scenes of `spec` to episode stores.

    Args:
        paths: paths of the stores.
        spec: layout of the scenes to forecast; its perception and frame hold for the examples too.
        horizon_steps: number of steps to forecast.
        source: origin of the scenes, for messages (``env 'merge-v1'``).
        k: number of neighbours to average.
        max_examples: largest number of examples; of more, this many are drawn.
        seed: random seed of that draw.

    Raises:
        UserError: a store cannot be read, has other features, time step or ego, or there is no example.
    """
    episodes: list[Episode] = []
    for path in paths:
        store = read_store(path)
        name = f"a forecaster of nearest neighbours in {path}"
        store.info.spec.check_compatible(spec, name, source)
        if store.info.spec.has_ego != spec.has_ego:
            raise UserError(
                f"{path} has has_ego={store.info.spec.has_ego} but {source} has has_ego={spec.has_ego}; "
                "record a store of the same kind"
            )
        episodes += store.episodes
    return NearestNeighbour.fit(episodes, spec, horizon_steps, k, max_examples, seed)


def _complete(
    episode: Episode, seen: Bool[np.ndarray, "time agents"], spec: SceneSpec, horizon_steps: int
) -> Bool[np.ndarray, "time agents"]:
    """Returns which agents are examples at which steps: as in windows, none whose future holds a new intervention."""
    steps = len(seen) - horizon_steps
    complete = np.zeros_like(seen)
    if steps < 1 or not seen.shape[1]:
        return complete
    future = np.lib.stride_tricks.sliding_window_view(episode.valid[1:], horizon_steps, axis=0)
    complete[:steps] = seen[:steps] & future.all(-1)
    complete &= foreseeable(episode, horizon_steps)[:, None]
    if spec.has_ego:
        complete &= episode.valid[:, :1]
        complete[:, 0] = False
    return complete


def _examples(
    episode: Episode,
    seen: Bool[np.ndarray, "time agents"],
    who: Int[np.ndarray, "examples 2"],
    spec: SceneSpec,
    horizon_steps: int,
) -> tuple[Float[Tensor, "examples features"], Float[Tensor, "examples horizon axes"]]:
    step, agent = who.T
    states = torch.from_numpy(np.array(episode.states, dtype=np.float32, order="C"))
    positions = states[..., : spec.position_dim]
    future = positions[step[:, None] + np.arange(1, horizon_steps + 1), agent[:, None]]
    features = query_features(spec, states, torch.from_numpy(np.array(seen, order="C")))
    return features[step, agent], future - positions[step, agent][:, None]
