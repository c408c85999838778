"""What somebody foresees who knows the drivers and the road, and of the rest what can be seen.

No forecaster of scenes knows as much: how each driver decides, and what it wishes. Goals, moments of looking aside and
all coming random numbers are drawn anew, several times; the mean of what then happens is what is foreseen. In two ways:
with every vehicle that is on the road, which bounds what can be known, and with those alone that the ego perceives.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from jaxtyping import Float

from envs.rollouts.branches import BranchPoint, copied
from envs.rollouts.interventions import body_of, kinds_of
from envs.rollouts.world import World, open_to_look
from envs.seeding import reseed
from envs.simulators.hidden_traffic import redraw_hidden
from envs.simulators.interventions import Intervention, simulator_of
from predictor.support.errors import UserError

FORESEEN = {"drivers known": False, "drivers known, perceived vehicles alone": True}
"""Names in tables → whether only the vehicles are known that the ego perceives."""


def check_can_foresee(env_id: str, driver: str, env_kwargs: str = "") -> None:
    """Checks that it is known what scenes of an environment do not show, so that it can be drawn anew.

    Raises:
        UserError: it is not one of highway-env with one ego, its reader cannot find a vehicle by its id, or the
            environment or the driver is unknown.
    """
    with closing(open_to_look(env_id, driver, env_kwargs)) as world:
        if not isinstance(simulator_of(world.env), AbstractEnv) or not world.spec.has_ego:
            raise UserError(
                f"hidden_draws needs an environment of highway-env with one ego, got '{env_id}'; set it to 0"
            )
        kinds_of(world)


def redrawn(world: World, rng: np.random.Generator, perceived_only: bool = False) -> World:
    """Returns a copy of a world of highway-env in which what cannot be seen is drawn anew.

    Args:
        world: running world; it is not changed.
        rng: source of the numbers.
        perceived_only: whether vehicles that the ego does not perceive are left out.
    """
    other = copied(world)
    simulator = simulator_of(other.env)
    if perceived_only:
        scene = other.perceived()
        seen = [body_of(other, int(agent)) for agent in scene.ids[scene.valid]]
        simulator.road.vehicles = [vehicle for vehicle in simulator.road.vehicles if vehicle in seen]
    redraw_hidden(simulator, rng)
    for generator in other.generators():
        reseed(generator, rng)
    return other


def foreseen_shift(
    world: World,
    intervention: Intervention,
    receiver: int,
    horizon_steps: int,
    draws: int,
    rng: np.random.Generator,
    *,
    perceived_only: bool = False,
) -> Float[np.ndarray, "horizon axes"]:
    """Returns the mean shift of an agent over worlds that look the same now [m], world axes.

    Draws in which the agent leaves the road or crashes in one of the branches do not count; without any other, 0.

    Args:
        world: running world of highway-env; it is not changed.
        intervention: what is done now.
        receiver: id of the agent.
        horizon_steps: number of steps to play.
        draws: number of worlds.
        rng: source of what is drawn.
        perceived_only: whether vehicles that the ego does not perceive are left out.
    """
    found = []
    for own in rng.spawn(draws):
        point = BranchPoint(redrawn(world, own, perceived_only), horizon_steps)
        branches = point.perturbed(intervention)
        shift_m = branches.shift_of(receiver)
        if shift_m is not None and receiver not in branches.crashed:
            found.append(shift_m)
    if not found:
        return np.zeros((horizon_steps, world.spec.position_dim))
    mean: Float[np.ndarray, "horizon axes"] = np.mean(found, axis=0)
    return mean


def foreseen_risk(
    world: World,
    drivers: Sequence[Callable[[], Callable[[Any], Any]]],
    horizon_steps: int,
    draws: int,
    rng: np.random.Generator,
    *,
    perceived_only: bool = False,
) -> Float[np.ndarray, " drivers"]:
    """Returns the share of worlds that look the same now in which the ego collides, for each driver of the ego.

    Args:
        world: running world of highway-env; it is not changed.
        drivers: functions that make a driver of the ego, which may keep count of its steps.
        horizon_steps: number of steps to play.
        draws: number of worlds.
        rng: source of what is drawn.
        perceived_only: whether vehicles that the ego does not perceive are left out.
    """
    hits = np.zeros(len(drivers))
    for own in rng.spawn(draws):
        point = BranchPoint(redrawn(world, own, perceived_only), horizon_steps, perturbs=False)
        hits += [int(point.ids[0]) in point.driven(make()).crashed for make in drivers]
    return hits / draws
