import gymnasium as gym
import numpy as np
import pytest

from envs.sampled_actions import uniform_action, varied_actions


@pytest.mark.parametrize(
    ("low", "high", "dtype"), [(0, 1, np.int8), (-1, 1, np.int64), (0, 5, np.uint8), (250, 255, np.uint8)]
)
def test_whole_numbers_are_drawn_equally_often_up_to_both_bounds(low: int, high: int, dtype: type):
    space, rng = gym.spaces.Box(low, high, (2,), dtype), np.random.default_rng(0)
    drawn = np.stack([uniform_action(space, rng, "drivers") for _ in range(1200)])
    assert drawn.dtype == dtype and space.contains(drawn[0])
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == list(range(low, high + 1))
    assert counts.min() > 0.75 * drawn.size / len(values)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_number_without_axes_is_drawn_too(dtype: type):
    space, rng = gym.spaces.Box(-1, 1, (), dtype), np.random.default_rng(0)
    drawn = [uniform_action(space, rng, "drivers") for _ in range(3)]
    assert all(space.contains(each) for each in drawn) and len({float(each) for each in drawn}) == 3


def test_an_environment_may_change_the_actions_it_is_given():
    """The choices are those of a driver whose actions nobody changes."""
    space = gym.spaces.Box(-1, 1, (2,))
    kind, changed = (varied_actions(space, np.random.default_rng(0), "drivers") for _ in range(2))
    for _ in range(30):
        action, other = kind(None), changed(None)
        np.testing.assert_array_equal(action, other)
        other *= 0.5
