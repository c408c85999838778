"""Random interventions in a recorded episode: at random moments, a random agent brakes, accelerates, … for a while.

They are drawn from a stream of their own, a function of the episode's seed alone (`envs.seeding.episode_rng`). One
agent at a time is perturbed, among those that forecasters get: others would not be seen reacting.
"""

from dataclasses import dataclass

import numpy as np

from envs.rollouts.interventions import intervene, interventions_of, is_on_roads, kinds_of
from envs.rollouts.world import World
from envs.simulators.interventions import Intervention, Kind, NotAllowedError
from predictor.support.errors import UserError

Range = tuple[float, float]
"""Bounds of a uniform distribution."""


@dataclass(frozen=True)
class PerturbationMix:
    """Distribution of random interventions."""

    duration_s: Range
    """Duration [s], rounded to whole policy steps, at least one."""
    brake_mps: Range
    """Loss of speed of brake [m/s], to rest at most."""
    accelerate_mps: Range
    """Gain of speed of accelerate [m/s]."""
    brake_mps2: Range | None
    """Deceleration [m/s²]; None is as hard as the family can."""
    accelerate_mps2: Range | None
    """Acceleration [m/s²]; None is as hard as the family can."""


ON_ROADS = PerturbationMix((1.0, 5.0), (3.0, 12.0), (2.0, 8.0), (3.0, 8.0), (1.5, 4.0))
"""Mix of highway-env: from firm to emergency braking."""
IN_ARENAS = PerturbationMix((0.3, 1.0), (0.2, 1.5), (0.2, 0.8), None, None)
"""Mix of mpe2, whose agents move at about 1 m/s."""
SHARES: dict[Kind, float] = {"brake": 0.4, "accelerate": 0.2, "left": 0.1, "right": 0.1, "remove": 0.2}
"""Probability of each kind; among fewer kinds, in proportion. A kind that an agent does not allow is drawn anew."""


def mix_for(world: World) -> PerturbationMix:
    """Returns the mix of the world's family.

    Raises:
        UserError: the world cannot be perturbed.
    """
    return ON_ROADS if is_on_roads(world) else IN_ARENAS


class Perturber:
    """Perturbs one episode.

    Args:
        world: the world; it has been reset.
        share: share of the steps during which one agent is perturbed, above 0, at most 1.
        kinds: kinds to draw from; empty takes all that the world allows.
        rng: source of all draws.

    Raises:
        UserError: the world cannot be perturbed, or does not allow one of the kinds.
    """

    def __init__(self, world: World, share: float, kinds: tuple[Kind, ...], rng: np.random.Generator) -> None:
        """Derives how often an intervention begins."""
        allowed = check_kinds(world, kinds)
        self._world, self._rng = world, rng
        self._mix = mix_for(world)
        self._kinds = allowed
        weights = np.array([SHARES[kind] for kind in allowed])
        self._weights = weights / weights.sum()
        steps = np.mean(self._mix.duration_s) / world.spec.dt_s
        self._start = share / (share + steps * (1 - share))  # idle for (1 - p) / p steps on average
        self._latest: tuple[int, Kind] | None = None  # agent and kind, until a step without intervention

    def __call__(self) -> None:
        """Begins an intervention, or none; called before each step.

        None repeats what ended at the step before: in a recording, both would be one.
        """
        if interventions_of(self._world):
            return
        ended, self._latest = self._latest, None
        if self._rng.random() >= self._start:
            return
        scene = self._world.perceived()
        for agent in self._rng.permutation(scene.ids[scene.valid]):
            for kind in self._rng.choice(self._kinds, len(self._kinds), replace=False, p=self._weights):
                if (agent, kind) == ended:
                    continue
                try:
                    intervene(self._world, self._draw(int(agent), kind))
                except NotAllowedError:
                    continue  # a landmark, the outermost lane, the ego taken out
                self._latest = (int(agent), kind)
                return

    def _draw(self, agent: int, kind: Kind) -> Intervention:
        uniform = self._rng.uniform
        steps = max(1, round(uniform(*self._mix.duration_s) / self._world.spec.dt_s))
        if kind not in ("brake", "accelerate"):
            return Intervention(agent, kind, steps)
        change, rate = self._mix.brake_mps, self._mix.brake_mps2
        if kind == "accelerate":
            change, rate = self._mix.accelerate_mps, self._mix.accelerate_mps2
        return Intervention(agent, kind, steps, uniform(*change), None if rate is None else uniform(*rate))


def check_kinds(world: World, kinds: tuple[Kind, ...]) -> tuple[Kind, ...]:
    """Returns the kinds to draw from: those given, or all that the world allows.

    Raises:
        UserError: the world cannot be perturbed, or does not allow one of the kinds.
    """
    allowed = kinds_of(world)
    for kind in kinds:
        if kind not in allowed:
            raise UserError(f"perturb_kinds must be among {', '.join(allowed)} in this environment, got {kind}")
    return kinds or allowed
