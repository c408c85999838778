"""Checks by playing an episode twice: the first agent obeys actions, and reading changes nothing.

By other actions from the same state it shows, too, whether the others' states are relative to the ego's.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from envs.testing.playing import Moment, OpenReader, begin, frozen, random_actions, step
from predictor.scene import SceneSpec

SEEDS, MAX_ACTIONS, ACTED_STEPS, REPLAYED_STEPS = 3, 5, 2, 10
ALIKE = 1e-9
CLEAR = 1e-5
"""Least change of the ego's state, in its scale, to which those of the others are compared: far above float32's."""
LEAST_CHANGES = 4
SEEN = 1e-3
"""Largest difference of states of equal seeds: simulators on many threads or a GPU round each time otherwise."""


def ego_problems(env: Any, opened: OpenReader, seed: int) -> list[str]:
    """Returns whether another agent than the first obeys the actions, or the others' states are relative to the ego's.

    Both need an environment that seeds determine.
    """
    acts = [partial(_always, action) for action in extreme_actions(env.action_space)]
    ends = [found for number in range(SEEDS) if (found := ends_of(env, opened, seed + number, acts)) is not None]
    return _obeys_another(ends, opened.spec) or _relative(ends, opened.spec)


Ends = list[list[dict[int, Any]]]
"""States after each number of steps → of each action → by the agents' places in the first scene."""


def _obeys_another(played: Sequence[Ends], spec: SceneSpec) -> list[str]:
    votes: list[int] = []
    own = strongest = 0.0
    for ends in played:
        effect = spread(ends[0], spec)
        if effect.max() > ALIKE:
            votes.append(int(effect.argmax()))
            own, strongest = max(own, effect[0]), max(strongest, effect.max())
    if len(votes) < 2 or len(set(votes)) > 1 or votes[0] == 0 or own > 0.5 * strongest:
        return []
    return [
        f"agent {votes[0]} of the scene obeys the actions, agent 0 does not: the ego must be the first agent of every "
        "scene"
    ]


def _relative(played: Sequence[Ends], spec: SceneSpec) -> list[str]:
    """Finds others that change by minus what another action changes of the ego: their states are relative to it."""
    axes = spec.position_dim
    for what, part in (("positions", slice(0, axes)), ("velocities", slice(axes, 2 * axes))):
        opposite: list[bool] = []
        for one, other in (pair for ends in played for pair in itertools.combinations(ends[-1], 2)):
            own = one[0][part] - other[0][part] if 0 in one and 0 in other else np.zeros(axes)
            size = float(np.linalg.norm(own))
            if size > CLEAR * min(spec.feature_scales[part]):
                rows = (one.keys() & other.keys()) - {0}
                opposite += [bool(np.linalg.norm(one[r][part] - other[r][part] + own) < 0.1 * size) for r in rows]
        if len(opposite) >= LEAST_CHANGES and np.mean(opposite) > 0.8:
            return [
                f"the others' {what} are relative to the ego: where an action moves the ego, they change by as much "
                "the other way; give all agents in the world frame (EntityRowsReader: relative=True)"
            ]
    return []


def _always(action: Any, env: Any) -> Any:
    return action


def extreme_actions(space: gym.Space) -> list[Any]:
    """Returns actions that differ as much as they can."""
    if isinstance(space, gym.spaces.Discrete):
        return [int(space.start) + i for i in range(min(int(space.n), MAX_ACTIONS))]
    if isinstance(space, gym.spaces.Box) and np.isfinite(space.low).all() and np.isfinite(space.high).all():
        middle = (space.low / 2 + space.high / 2).astype(space.dtype)
        return [space.low.copy(), middle, space.high.copy()]
    space.seed(0)
    return [space.sample() for _ in range(MAX_ACTIONS)]


def ends_of(env: Any, opened: OpenReader, seed: int, acts: Sequence[Callable[[Any], Any]]) -> Ends | None:
    """Returns what each driver leads to in the first steps; None without a replay.

    Args:
        env: the environment.
        opened: its reader.
        seed: seed of all resets.
        acts: drivers, each of which takes the environment and returns the action.
    """
    ends: Ends = [[] for _ in range(ACTED_STEPS)]
    begins = []
    for act in acts:
        begin(env, opened, seed)
        begins.append(opened.read(env))
        for after in ends:
            *_, over = step(env, opened, act(env))
            after.append(_by_first_row(begins[-1], opened.read(env)))
            if over:
                break
    if any(not _same(begins[0], other) for other in begins[1:]):
        return None
    return [after for after in ends if after]


def _by_first_row(first: Moment, second: Moment) -> dict[int, Any]:
    """Returns the later states by the agents' places in the first scene."""
    rows = second.index_of
    return {row: second.states[rows[number]] for row, number in enumerate(first.ids.tolist()) if number in rows}


def _same(one: Moment, other: Moment) -> bool:
    return one.states.shape == other.states.shape and bool(np.allclose(one.states, other.states, rtol=0, atol=ALIKE))


def spread(ends: Sequence[dict[int, Any]], spec: SceneSpec) -> Any:
    """Returns how far each agent's state depends on the action, in units of its scale."""
    effect = np.zeros(1 + max((row for end in ends for row in end), default=0))
    used = 2 * spec.position_dim
    for one, other in itertools.combinations(ends, 2):
        for row in one.keys() & other.keys():
            change = np.abs(one[row][:used] - other[row][:used]) / np.array(spec.feature_scales[:used])
            effect[row] = max(effect[row], float(change.max()))
    return effect


def replay_problems(env: Any, opened: OpenReader, seed: int) -> list[str]:
    """Returns whether a seed begins other episodes each time, or an episode goes on differently when it is read.

    The latter is not known where seeds do not determine an episode.
    """
    first, second = _begun(env, opened, seed), _begun(env, opened, seed)
    if first.shape != second.shape or not np.allclose(first, second, rtol=0, atol=SEEN):
        return [
            f"two resets with seed {seed} begin different episodes, so nothing can be compared or repeated: reset must "
            "make all its random numbers from its seed (gymnasium: super().reset(seed=seed), then self.np_random)"
        ]
    unread = [_seen(env, None, seed) for _ in range(2)]
    if unread[0] != unread[1]:
        return []
    if _seen(env, opened, seed) != unread[0]:
        return [f"{opened.name}: reading changes what happens in the environment; a reader must not draw or step"]
    return []


def _begun(env: Any, opened: OpenReader, seed: int) -> Any:
    """Returns the first states of an episode, each feature sorted: the order of the agents is of no matter."""
    begin(env, opened, seed)
    return np.sort(opened.read(env).states, axis=0)


def _seen(env: Any, opened: OpenReader | None, seed: int) -> list[Any]:
    """Returns observations and rewards of the first steps of an episode."""
    act, seen = random_actions(env, seed), []
    begin(env, opened, seed)
    for number in range(REPLAYED_STEPS):
        if opened is not None:
            opened.read(env)
        *shown, over = step(env, opened, act(number))
        seen.append(frozen(shown))
        if over:
            break
    return seen
