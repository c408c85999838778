"""Checks of names and of what each agent of a PettingZoo environment is given, on episodes written by hand."""

from typing import Any

import numpy as np
import pytest

from envs.testing.names import name_problems
from envs.testing.playing import Episode, Moment


def episode(**changes: Any) -> Episode:
    """Two agents; "b" ends in the first of two steps, in which it is still observed."""
    parts: dict[str, Any] = {
        "named": [{"a": 1, "b": 2}, {"a": 1, "b": 2}, {"a": 1}],
        "shown": [{"a": 0, "b": 0}, {"a": 0, "b": 0}, {"a": 0}],
        "rewards": [{"a": 0, "b": 0}, {"a": 0}],
        "living": [["a", "b"], ["a"], ["a"]],
    }
    parts |= changes
    moments = [Moment(np.zeros((2, 4)), np.array([1, 2]), 0.0, named) for named in parts.pop("named")]
    return Episode(moments, **parts)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({}, ""),
        ({"named": [{"a": 1}, {"a": 1}, {"a": 1}]}, "each agent that lives, but lacks ['b'] after the reset"),
        ({"named": [{"a": 1, "b": 2}, {"a": 1}, {"a": 1}]}, "lacks ['b'] in step 1, its last one"),
        ({"named": [{"a": 1, "b": 2}] * 3}, "names ['b'] in step 2, which neither lives nor is observed"),
        ({"named": [{"a": 1, "b": 2}, {"a": 2, "b": 1}, {"a": 2}]}, "'a' lives on in step 1, but its id changes"),
        ({"shown": [{"a": 0, "b": 0}, {"b": 0}, {"a": 0}]}, "no observation for ['a'], alive in step 1"),
        ({"rewards": [{"a": 0}, {"a": 0}]}, "no reward for ['b'], who acted in step 1"),
    ],
)
def test_each_mistake_is_a_line(changes: dict[str, Any], line: str):
    found = name_problems([episode(), episode(**changes)])
    assert len(found) == bool(line) and all(line in text for text in found)
