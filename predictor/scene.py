"""Types that all modules exchange: layout of a scene (`SceneSpec`), `Scene`, `SceneBatch` and `Forecast`.

States are in the world frame and SI units. Where a scene has an ego, it is agent 0, always. Padded agents are
`valid=False`, hold zeros and id -1. The first features are always position and velocity, on two axes or three.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from predictor.graph import to_dense
from predictor.support.config_checks import check_types, make_plain
from predictor.support.errors import UserError, short, some

KINEMATIC_FEATURES = ("x_m", "y_m", "vx_mps", "vy_mps")
KINEMATIC_FEATURES_3D = ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps")
LARGEST = np.float64(1e30)
"""Largest size of a state; float32 holds it, and differences of two (NumPy's: a float would be cast to float16)."""
PADDING_ID = -1
MOST_AGENTS = 65_536
"""Largest number of agents of a scene."""
MOST_FEATURES = 1_024
"""Largest number of features of an agent."""

AxisFrame = Literal["ego", "world", "centroid"]


@dataclass(frozen=True)
class SceneSpec:
    """Layout of scenes, on which readers and forecasters must agree; kept in every checkpoint."""

    dt_s: float
    """Time between two scenes [s]."""
    frame: tuple[AxisFrame, ...] = ("world", "world")
    """Origin that is subtracted from positions at each step, per axis: "ego" the ego's position (unbounded roads),
    "centroid" the mean of all present agents (no agent is special, the place does not matter), "world" nothing (fixed
    maps). Positions are float32 in recordings and, but for "ego", before that: within 100 km at most 4 mm off."""
    feature_names: tuple[str, ...] = KINEMATIC_FEATURES
    """Columns of a state; position and velocity come first, on two or three axes."""
    feature_scales: tuple[float, ...] = (100.0, 100.0, 30.0, 30.0)
    """Divisors that bring each feature to order one for the network."""
    has_ego: bool = True
    """Whether agent 0 is the learner; marks for the network the agent that does not drive like the others."""
    perception_m: float = 100.0
    """Largest distance at which the ego perceives an agent [m]; agents beyond are not in the scene."""
    max_agents: int = 12
    """Largest number of agents in a scene, the ego included; the nearest are kept."""
    constant_features: tuple[str, ...] = ()
    """Features that never change while an agent is there (a role, a size): given to the network, never predicted."""

    def __post_init__(self) -> None:
        """Checks that the fields fit together."""
        check_types(self)
        make_plain(self)
        if not 0 < self.dt_s < float("inf"):
            raise UserError(f"dt_s must be positive, got {self.dt_s}")
        if self.feature_names[:4] != KINEMATIC_FEATURES and self.feature_names[:6] != KINEMATIC_FEATURES_3D:
            wanted = f"{KINEMATIC_FEATURES} or {KINEMATIC_FEATURES_3D}"
            raise UserError(f"the first features must be {wanted}, got {self.feature_names[:6]}")
        if len(self.frame) != self.position_dim or not set(self.frame) <= {"ego", "world", "centroid"}:
            axes = {2: "two", 3: "three"}[self.position_dim]
            raise UserError(f"frame must be 'ego', 'world' or 'centroid' for each of {axes} axes, got {self.frame}")
        positive = all(0 < scale < float("inf") for scale in self.feature_scales)
        if len(self.feature_scales) != len(self.feature_names) or not positive:
            raise UserError(
                f"feature_scales needs one positive number per feature ({len(self.feature_names)}), "
                f"got {self.feature_scales}"
            )
        predicted = self.feature_names[: 2 * self.position_dim]
        if not set(self.constant_features) <= set(self.feature_names) - set(predicted):
            raise UserError(
                f"constant_features must be among the features beyond velocity, got {self.constant_features} of "
                f"{self.feature_names}"
            )
        if self.max_agents < 1 or not self.perception_m > 0:
            raise UserError(
                f"max_agents must be at least 1 and perception_m positive, got {self.max_agents}, {self.perception_m}"
            )
        if self.max_agents > MOST_AGENTS or self.num_features > MOST_FEATURES:
            raise UserError(
                f"max_agents must be at most {MOST_AGENTS:,} and the number of features at most {MOST_FEATURES:,}, "
                f"got {self.max_agents} and {self.num_features}"
            )
        if "ego" in self.frame and not self.has_ego:
            raise UserError("an 'ego' frame needs has_ego=True; use 'world' or 'centroid'")

    @property
    def position_dim(self) -> int:
        """Number of axes of a position, which fills the first columns of a state; velocity fills as many after it."""
        return 3 if self.feature_names[:6] == KINEMATIC_FEATURES_3D else 2

    @property
    def num_features(self) -> int:
        """Number of features of a state."""
        return len(self.feature_names)

    def check_compatible(self, other: "SceneSpec", name: str, source: str) -> None:
        """Raises unless a forecaster of this spec can observe scenes of `other`.

        Args:
            other: spec of the observed scenes.
            name: owner of this spec, for the message (``checkpoint 'highway'``).
            source: origin of the scenes, for the message (``env 'racetrack-v1'``).

        Raises:
            UserError: features or time step differ, or only the scenes have an ego.
        """
        if other.has_ego and not self.has_ego:
            raise UserError(
                f"{name} was trained on scenes without an ego but {source} has one; retrain on its data, or on tracks "
                "with an ego"
            )
        if self.feature_names != other.feature_names:
            raise UserError(
                f"{name} was trained on features {self.feature_names} but {source} gives {other.feature_names}; "
                "retrain on its data or use another reader"
            )
        if abs(self.dt_s - other.dt_s) > 1e-6:
            raise UserError(
                f"{name} was trained at dt_s={self.dt_s:g} but {source} steps at dt_s={other.dt_s:g}; "
                "retrain on its data, or change the step (policy_frequency, your SceneSpec, --frame-step of tracks)"
            )

    def check_recorded(self, other: "SceneSpec", name: str, source: str) -> None:
        """Raises unless episodes of `other` can be cut into windows of this spec.

        Unlike a live scene, in which an absent ego can stand before the agents (`Scene.behind_absent`), the first agent
        of a recording without an ego would be taken for it.

        Args:
            other: spec of the recorded episodes.
            name: owner of this spec, for the message.
            source: origin of the episodes, for the message.

        Raises:
            UserError: as `check_compatible`; or only one of both has an ego.
        """
        self.check_compatible(other, name, source)
        if self.has_ego and not other.has_ego:
            raise UserError(
                f"{name} needs episodes with an ego but {source} has none (has_ego=False); record a store with an ego, "
                "or use a checkpoint that was trained without one"
            )


@dataclass(frozen=True)
class Scene:
    """All agents at one instant, padded to a fixed number."""

    states: Float[np.ndarray, "agents state"]
    """States in the world frame, SI units, float64; agent 0 is the ego where there is one. Finite, also those of padded
    agents."""
    ids: Int[np.ndarray, " agents"]
    """Identity of each agent, constant from step to step; -1 for padded agents."""
    valid: Bool[np.ndarray, " agents"]
    """Which entries hold an agent."""
    heading_rad: float = 0.0
    """Heading of the ego, which turns world axes into ego axes; 0 where agents have none."""

    def copy(self) -> "Scene":
        """Returns the scene with arrays of its own."""
        return Scene(self.states.copy(), self.ids.copy(), self.valid.copy(), self.heading_rad)

    def behind_absent(self, agents: int) -> "Scene":
        """Returns the scene behind `agents` absent ones, for a forecaster with an ego where no agent is the ego."""
        return Scene(
            np.pad(self.states, ((agents, 0), (0, 0))),
            np.pad(self.ids.astype(np.int64), (agents, 0), constant_values=PADDING_ID),
            np.pad(self.valid, (agents, 0)),
            self.heading_rad,
        )

    def check(self, source: str = "reader", spec: SceneSpec | None = None, agents: int | None = None) -> None:
        """Raises unless the scene is well-formed.

        Args:
            source: name of its reader, for messages.
            spec: required features and ego; None requires an ego and takes any features.
            agents: required number of agents, padding included; None takes any.

        Raises:
            UserError: wrong types or shapes, no ego, duplicate or negative ids, non-finite values.
        """
        self._check_arrays(source, spec, agents)
        if (spec is None or spec.has_ego) and not (len(self.valid) and self.valid[0]):
            raise UserError(f"{source}: agent 0 must be the ego, but it is absent or not valid")
        live = self.ids[self.valid].tolist()
        if len(set(live)) != len(live):
            raise UserError(f"{source}: ids must be unique within a scene, got {short(live)}")
        if min(live, default=0) < 0:
            raise UserError(f"{source}: ids of valid agents must be non-negative, got {short(live)}")
        number = isinstance(self.heading_rad, int | float | np.integer | np.floating)
        if not number or not np.isfinite(self.heading_rad):
            raise UserError(f"{source}: heading_rad must be one finite number, got {self.heading_rad}")
        right = (np.abs(self.states) <= LARGEST).all(axis=1)
        if not right.all():
            finite = np.isfinite(self.states).all()
            wanted = f"at most {LARGEST:g} in size" if finite else "finite, those of padded agents too (zeros)"
            got = f"{some(self.states[~right].tolist())} of ids {some(self.ids[~right].tolist())}"
            raise UserError(f"{source}: states must be {wanted}, got {got}")

    def _check_arrays(self, source: str, spec: SceneSpec | None, agents: int | None) -> None:
        for name, array, kind, wanted, axes, advice in (
            ("states", self.states, "f", "floating point", 2, "; np.asarray(states, dtype=float) makes one"),
            ("ids", self.ids, "iu", "integers", 1, "; agent_ids(names) (dgvae_rl) makes numbers of names"),
            ("valid", self.valid, "b", "bool", 1, ""),
        ):
            if not isinstance(array, np.ndarray) or array.dtype.kind not in kind or array.ndim != axes:
                got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
                raise UserError(
                    f"{source}: {name} must be a NumPy array of {wanted} with {axes} axes, got {got}{advice}"
                )
        if not len(self.states) == len(self.ids) == len(self.valid):
            raise UserError(
                f"{source}: states, ids and valid need one entry per agent, got {len(self.states)}, "
                f"{len(self.ids)} and {len(self.valid)}"
            )
        if spec is not None and self.states.shape[1] != spec.num_features:
            raise UserError(
                f"{source}: states need {spec.num_features} features {spec.feature_names}, got {self.states.shape[1]}"
            )
        if agents is not None and len(self.ids) != agents:
            raise UserError(
                f"{source}: a scene needs {agents} agents (max_agents), padding included, got {len(self.ids)}"
            )


@dataclass(frozen=True)
class SceneBatch:
    """Scenes of many environments at one instant."""

    states: Float[np.ndarray, "batch agents state"]
    """States in the world frame, SI units, float64."""
    ids: Int[np.ndarray, "batch agents"]
    """Identity of each agent; -1 for padded agents."""
    valid: Bool[np.ndarray, "batch agents"]
    """Which entries hold an agent."""
    heading_rad: Float[np.ndarray, " batch"]
    """Heading of each ego; 0 where agents have none."""

    @staticmethod
    def stack(scenes: Sequence[Scene]) -> "SceneBatch":
        """Stacks scenes of equal size."""
        return SceneBatch(
            np.stack([s.states for s in scenes]),
            np.stack([np.asarray(s.ids, dtype=np.int64) for s in scenes]),
            np.stack([s.valid for s in scenes]),
            np.array([s.heading_rad for s in scenes], dtype=np.float64),
        )

    def __len__(self) -> int:
        """Number of scenes in the batch."""
        return len(self.states)

    def __getitem__(self, envs: Int[np.ndarray, " envs"] | slice) -> "SceneBatch":
        """Returns the scenes of the given environments, as a batch; of a slice without copying them."""
        return SceneBatch(self.states[envs], self.ids[envs], self.valid[envs], self.heading_rad[envs])

    @staticmethod
    def concatenate(first: "SceneBatch", second: "SceneBatch") -> "SceneBatch":
        """Returns the scenes of `first`, then those of `second`."""
        return SceneBatch(
            np.concatenate([first.states, second.states]),
            np.concatenate([first.ids, second.ids]),
            np.concatenate([first.valid, second.valid]),
            np.concatenate([first.heading_rad, second.heading_rad]),
        )


def perceived_agents(
    states: Float[np.ndarray, "*batch agents state"],
    valid: Bool[np.ndarray, "*batch agents"],
    ego: int | Int[np.ndarray, "*batch"],
    spec: SceneSpec,
) -> tuple[Int[np.ndarray, "*batch nearest"], Bool[np.ndarray, "*batch nearest"]]:
    """Finds what an ego perceives: itself, then the nearest agents, at most `max_agents`, within `perception_m`.

    Agents at equal distances keep their order; the ego comes first also when another agent is at the same position.

    Args:
        states: states in the world frame; entries of agents that are not valid are ignored.
        valid: which entries hold an agent.
        ego: index of the ego, one for all scenes or one for each.
        spec: source of `perception_m`, `max_agents` and `position_dim`.

    Returns:
        Indices of agents in this order, as many as there are, at most `max_agents`; and which of them are perceived:
        the others are too far away or not valid.
    """
    positions = states[..., : spec.position_dim]
    if isinstance(ego, int):
        offsets = positions - positions[..., ego : ego + 1, :]
    else:
        offsets = positions - np.take_along_axis(positions, ego[..., None, None], axis=-2)
    distance_m = np.where(valid, np.sqrt(np.square(offsets).sum(axis=-1)), np.inf)
    if isinstance(ego, int):
        distance_m[..., ego] = -1.0
    else:
        np.put_along_axis(distance_m, ego[..., None], -1.0, axis=-1)
    order = np.argsort(distance_m, axis=-1, kind="stable")[..., : spec.max_agents]
    return order, np.take_along_axis(valid & (distance_m <= spec.perception_m), order, axis=-1)


@dataclass(frozen=True)
class Forecast:
    """Forecast of the steps that follow one instant."""

    xy: Float[Tensor, "batch *plans samples agents horizon axes"]
    """Predicted positions [m], world axes; relative to the ego's position now, or to the world's origin where there is
    no ego (a spec without one, or an absent agent 0). Zeros where `valid` is not. With plans of the ego there is an
    axis for them, also in `mode_probs` and `xy_scale`; `of_plan` takes one."""
    edge_probs: Float[Tensor, "batch agents slots types"]
    """Prior probabilities of edge types now, receiver first; type 0 is "no edge"."""
    edge_features: Float[Tensor, "batch agents slots feature"]
    """Edge features now, receiver first."""
    valid: Bool[Tensor, "batch agents"]
    """Which agents are forecast."""
    senders: Int[Tensor, "batch agents slots"] | None = None
    """Index of the sender in each slot (`predictor.graph.NO_AGENT` where empty); None if slot j is agent j's."""
    mode_probs: Float[Tensor, "batch *plans samples agents"] | None = None
    """Probability of each sample for each agent, which sum to 1 over the samples; None if the samples are draws."""
    xy_scale: Float[Tensor, "batch *plans samples agents horizon axes"] | None = None
    """Standard deviation of the position around each sample [m], world axes; None without an estimate."""

    @property
    def num_plans(self) -> int:
        """Number of plans of the ego that the forecast has an axis for; 0 for a forecast without plans."""
        return self.xy.shape[1] if self.xy.ndim == 6 else 0

    def of_plan(self, plan: int) -> "Forecast":
        """Returns the forecast for one plan of the ego, without the axis of plans.

        Raises:
            UserError: there is no such plan.
        """
        if not 0 <= plan < self.num_plans:
            raise UserError(f"plan must be from 0 to {self.num_plans - 1}, the plans of this forecast, got {plan}")
        return replace(
            self,
            xy=self.xy[:, plan],
            mode_probs=None if self.mode_probs is None else self.mode_probs[:, plan],
            xy_scale=None if self.xy_scale is None else self.xy_scale[:, plan],
        )

    def dense(self) -> "Forecast":
        """Returns the forecast with slot j for agent j; of use where scenes are small."""
        if self.senders is None:
            return self
        probs, features = dense_edges(self.edge_probs, self.edge_features, self.senders)
        return replace(self, edge_probs=probs, edge_features=features, senders=None)

    def without_first(self, agents: int) -> "Forecast":
        """Returns the forecast of all agents but the first ones, dense."""
        if not agents:
            return self.dense()
        dense = self.dense()
        return Forecast(
            dense.xy[..., agents:, :, :],
            dense.edge_probs[:, agents:, agents:],
            dense.edge_features[:, agents:, agents:],
            dense.valid[:, agents:],
            mode_probs=None if dense.mode_probs is None else dense.mode_probs[..., agents:],
            xy_scale=None if dense.xy_scale is None else dense.xy_scale[..., agents:, :, :],
        )

    def sample_probs(self) -> Float[Tensor, "batch *plans samples agents"]:
        """Returns the probability of each sample, which is the same for all draws."""
        if self.mode_probs is not None:
            return self.mode_probs
        return self.xy.new_full(self.xy.shape[:-2], 1 / self.xy.shape[-4])

    def ego_edges(self) -> tuple[Float[Tensor, "batch agents 2 types"], Float[Tensor, "batch agents 2 feature"]]:
        """Returns probabilities and features of the edges from each agent to agent 0, and of those back."""
        if self.senders is None:
            probs, features = self.edge_probs, self.edge_features
            return torch.stack([probs[:, 0], probs[:, :, 0]], 2), torch.stack([features[:, 0], features[:, :, 0]], 2)
        agents = torch.arange(self.senders.shape[1], device=self.senders.device)
        to_ego = (self.senders[:, 0, :, None] == agents).transpose(1, 2)
        from_ego = self.senders == 0
        found = torch.stack([to_ego, from_ego], 2).to(self.xy.dtype)
        slots = [torch.stack([t[:, :1].expand_as(t), t], 2) for t in (self.edge_probs, self.edge_features)]
        probs, features = (torch.matmul(found[..., None, :], t)[..., 0, :] for t in slots)
        probs[..., 0] = 1 - probs[..., 1:].sum(-1)  # an agent without a slot has no edge
        return probs, features


def dense_edges(
    probs: Float[Tensor, "batch agents slots types"],
    features: Float[Tensor, "batch agents slots feature"],
    senders: Int[Tensor, "batch agents slots"],
) -> tuple[Float[Tensor, "batch agents agents types"], Float[Tensor, "batch agents agents feature"]]:
    """Returns edge probabilities and features with slot j for agent j; "no edge" and zeros where there is no slot."""
    no_edge = probs.new_zeros(probs.shape[-1])
    no_edge[0] = 1.0
    return to_dense(probs, senders, no_edge), to_dense(features, senders, features.new_zeros(features.shape[-1]))
