"""Arms of a controlled comparison: which part of a forecast an observation shows.

All arms have the same entries in the same shapes, so that the same network reads them; what an arm does not show is
zero. The other agents' present states (`agents`, `valid`) and the ego's own path are part of every arm. Arms therefore
differ only in what they tell about the others' future, or about who interacts with whom.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from predictor.forecaster import Forecaster, has_scale
from predictor.support.config_checks import check_choice
from predictor.support.errors import UserError
from predictor.support.typed_values import from_table

PRESENT_KEYS = ("agents", "valid", "ego_path")
"""Entries on the present and on the ego itself, which every arm shows."""
EDGE_KEYS = ("edge_probs", "edge_features")
"""Entries on who interacts with whom."""
_PROBS = "mode_probs"
_AXES_WITH_SAMPLES = {"forecast": 5, _PROBS: 3, "xy_scale": 5}
"""Number of axes of an entry that has room for several samples, the batch included; theirs is the third."""


@dataclass(frozen=True)
class Shown:
    """Parts of a forecast that an arm shows."""

    what: str
    """What the arm shows, in words."""
    future: bool = True
    """Whether it shows where the others will be: one future of each agent."""
    modes: bool = True
    """Whether it shows all futures of each agent, where the observation has room for several."""
    edges: bool = True
    """Whether it shows probabilities and features of edges."""
    what_if: bool = True
    """Whether it shows what the others do in each candidate plan, where the observation has room for it."""
    true_futures: bool = False
    """Whether the futures are those that the simulator plays, instead of the forecaster's."""
    other_scene: bool = False
    """Whether everything is taken from a scene of another episode."""


ARMS: dict[str, Shown] = {
    "forecast": Shown("everything that the observation has room for"),
    "single": Shown("the single forecast and edges", modes=False, what_if=False),
    "no-edges": Shown("the single forecast", modes=False, edges=False, what_if=False),
    "edges-only": Shown("edges", future=False, modes=False, what_if=False),
    "modes": Shown("all futures with their probabilities, and edges", what_if=False),
    "what-if": Shown("the single forecast, edges, and the others in each candidate plan", modes=False),
    "zeros": Shown("nothing", future=False, modes=False, edges=False, what_if=False),
    "shuffled": Shown("a forecast of another episode's scene", other_scene=True),
    "oracle": Shown("what happens if the ego keeps on", modes=False, edges=False, what_if=False, true_futures=True),
    "oracle-what-if": Shown(
        "what happens if the ego keeps on, and in each candidate plan", modes=False, edges=False, true_futures=True
    ),
}
"""Name of an arm → what it shows."""


@dataclass(frozen=True)
class EntryLayout:
    """Sizes of forecast entries that depend on the forecaster."""

    num_edge_types: int
    """Number of edge types, "no edge" included."""
    edge_feature_dim: int
    """Number of features of an edge."""
    has_scale: bool
    """Whether there is a standard deviation around each future."""

    @classmethod
    def of(cls, forecaster: Forecaster) -> "EntryLayout":
        """Returns the sizes of a forecaster's own entries."""
        return cls(forecaster.num_edge_types, forecaster.edge_feature_dim, has_scale(forecaster))


@dataclass(frozen=True)
class EntryBank:
    """Forecast entries of scenes of other episodes, each with at least one agent beside the ego."""

    source: str
    """Description of the episodes; banks of the same source are equal."""
    entries: Mapping[str, Float[np.ndarray, "scenes others ..."]] = field(compare=False, repr=False)
    """Entries by key, agents as in `envs.entries.ego_entries`."""

    def drawn_for(self, present: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.float32]]:
        """Returns entries of recorded scenes, for the agents of present ones.

        The recorded scene is chosen by a checksum of the present one: the same in every run, and unrelated to what is
        seen. Where it has fewer agents, they are repeated.

        Args:
            present: entries of the present scenes, `agents` and `valid` among them.
        """
        valid = present["valid"]
        sums = [zlib.crc32(np.ascontiguousarray(scene).tobytes()) for scene in present["agents"]]
        chosen = np.array(sums, dtype=np.int64) % len(self.entries["valid"])
        others = self.entries["valid"][chosen].sum(axis=1).astype(np.int64)
        slots = np.arange(valid.shape[1]) % others[:, None]
        drawn = {}
        for key, recorded in self.entries.items():
            if key not in PRESENT_KEYS:
                values = recorded[chosen[:, None], slots]
                drawn[key] = values * valid.reshape(*valid.shape, *(1,) * (values.ndim - 2))
        return drawn


def arm_of(arm: "Arm | Mapping[str, Any] | None") -> "Arm":
    """Returns an arm; for None, the one that shows all of a forecast.

    Args:
        arm: an arm, or its fields as an `EnvSpec` in JSON has them.

    Raises:
        UserError: it is something else.
    """
    if isinstance(arm, Mapping):
        return from_table(Arm, arm, "arm")
    if arm is not None and not isinstance(arm, Arm):
        raise UserError(f"arm must be an Arm, for example Arm('zeros') of envs.arms, got {arm!r}")
    return Arm() if arm is None else arm


@dataclass(frozen=True)
class Arm:
    """Fills the entries of an observation with what an arm shows.

    Args:
        name: a key of `ARMS`.
        layout: sizes of the entries; None takes the forecaster's own. What the forecaster lacks is zero.
        bank: scenes of other episodes, for the arm "shuffled".

    Raises:
        UserError: unknown name.
    """

    name: str = "forecast"
    layout: EntryLayout | None = None
    bank: EntryBank | None = None

    def __post_init__(self) -> None:
        """Checks the name."""
        check_choice("arm", self.name, tuple(ARMS))

    @property
    def shown(self) -> Shown:
        """Parts of a forecast that the arm shows."""
        return ARMS[self.name]

    def check_room(self, num_samples: int, what_if: bool) -> None:
        """Checks that an observation has room for what the arm is named after.

        Args:
            num_samples: number of futures per agent that the observation has room for.
            what_if: whether it has room for what the others do in each candidate plan.

        Raises:
            UserError: the arm shows several futures, or candidate plans, and there is no room: it would be another arm.
        """
        if self.name == "modes" and num_samples == 1:
            raise UserError(
                "arm modes shows several futures per agent; set num_samples to 2 or more, or take arm single"
            )
        if self.name in ("what-if", "oracle-what-if") and not what_if:
            less = "single" if self.name == "what-if" else "oracle"
            raise UserError(f"arm {self.name} shows candidate plans of the ego; set what_if, or take arm {less}")

    @property
    def changes_nothing(self) -> bool:
        """Whether entries are shown as they are."""
        return self.name == "forecast" and self.layout is None

    def plays(self, what_if: bool) -> int | None:
        """Returns how many of the ego's plans a simulator plays for this arm: 0, 1, or None for all of them.

        Args:
            what_if: whether the observation has room for what the others do in each candidate plan.
        """
        if not self.shown.true_futures:
            return 0
        return None if what_if and self.shown.what_if else 1

    def layout_for(self, forecaster: Forecaster) -> EntryLayout:
        """Returns the sizes of the entries with this forecaster.

        Raises:
            UserError: its edges, if the arm shows them, are larger than those of the layout.
        """
        own = EntryLayout.of(forecaster)
        if self.layout is None:
            return own
        sizes = [(each.num_edge_types, each.edge_feature_dim) for each in (own, self.layout)]
        if self.shown.edges and any(mine > room for mine, room in zip(*sizes, strict=True)):
            raise UserError(
                "the forecaster has edges of {} types with {} features, and the observation room for {} with {}; take "
                "the sizes of a checkpoint with room for them (sizes_of)".format(*sizes[0], *sizes[1])
            )
        return self.layout

    def filled(
        self, entries: Mapping[str, NDArray[np.float32]], spaces: Mapping[str, gym.Space]
    ) -> dict[str, NDArray[np.float32]]:
        """Returns the entries of a batch of scenes as the arm shows them, in the shapes of `spaces`.

        Args:
            entries: entries of the forecast, a batch of scenes each; keys and trailing sizes may be missing.
            spaces: space of each entry of one scene.

        Raises:
            UserError: the arm shows scenes of other episodes, and has none, or those with other entries or sizes.
        """
        batch = len(entries["valid"])
        if self.shown.other_scene:
            if self.bank is None:
                raise UserError(
                    f"arm '{self.name}' shows other episodes: pass bank=record_bank(...) of envs.entry_bank"
                )
            present = {key: values for key, values in entries.items() if key in PRESENT_KEYS}
            drawn = self.bank.drawn_for(present)
            if lacking := [key for key in spaces if key in entries and key not in (*present, *drawn)]:
                raise UserError(
                    f"arm '{self.name}': the bank has no '{lacking[0]}', which is shown here; record the bank with "
                    "this environment, this forecaster and the same options"
                )
            entries = {**present, **drawn}
        found = {}
        for key, space in spaces.items():
            full = np.zeros((batch, *(space.shape or ())), dtype=np.float32)
            if key in entries and self._shows(key):
                several = full.ndim == _AXES_WITH_SAMPLES.get(key)
                target, values = full, entries[key]
                if key in EDGE_KEYS:
                    target, values = _halves(full), _halves(values)
                elif self.shown.other_scene and values.shape[2:] != full.shape[2:]:
                    raise UserError(
                        f"arm '{self.name}': '{key}' of an agent has the shape {full.shape[2:]} here and "
                        f"{values.shape[2:]} in the bank; record the bank with this environment and forecaster"
                    )
                _fill(target, values, only_first=several and not self.shown.modes)
            found[key] = full
        return found

    def _shows(self, key: str) -> bool:
        if key in PRESENT_KEYS:
            return True
        if key in EDGE_KEYS:
            return self.shown.edges
        return self.shown.what_if if key.startswith("what_if") else self.shown.future


def _halves(edges: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns a view with the two directions apart: agent → ego, ego → agent."""
    return edges.reshape(*edges.shape[:-1], 2, edges.shape[-1] // 2)


def _fill(full: NDArray[np.float32], values: NDArray[np.float32], only_first: bool) -> None:
    """Writes values into the leading places of `full`, which may have an axis of samples that they lack.

    Args:
        full: array to fill.
        values: values with as many axes, or without the third one.
        only_first: whether of several samples the first alone is written.
    """
    if values.ndim < full.ndim:
        values = values[:, :, None]
    elif only_first:
        values = values[:, :, :1]
    full[tuple(slice(size) for size in values.shape)] = values
