from dataclasses import dataclass
from typing import Any, Literal, Optional, Union

import pytest

from predictor.support.config_checks import check_at_least, check_choices, check_positive
from predictor.support.errors import UserError

Colour = Literal["red", "blue"]


@dataclass(frozen=True)
class Choices:
    plain: Colour = "red"
    optional: Colour | None = None
    old_style: Optional[Colour] = None  # noqa: UP045
    several: tuple[Colour, ...] = ()
    either: Union[Colour, Literal["none"]] = "none"  # noqa: UP007
    open: Colour | int = 3
    free: str = "anything"

    def __post_init__(self) -> None:
        check_choices(self)


@dataclass(frozen=True)
class Inherited(Choices):
    more: Literal[1, 2] = 1


@dataclass(frozen=True)
class Numbers:
    count: int | None = 1
    counts: tuple[int, ...] = ()
    rate: float = 0.5


def test_listed_choices_pass():
    Choices("blue", "red", "blue", ("red", "blue", "red"), "red", 7, "yes")
    Inherited(more=2)


@pytest.mark.parametrize(
    ("cls", "given", "message"),
    [
        (Choices, {"plain": "rde"}, "plain must be one of red, blue, got 'rde'"),
        (Choices, {"plain": None}, "plain must be one of red, blue, got 'None'"),
        (Choices, {"optional": "rde"}, "optional must be one of red, blue, got 'rde'"),
        (Choices, {"old_style": "rde"}, "old_style must be one of red, blue, got 'rde'"),
        (Choices, {"several": ("red", "rde")}, "several must be one of red, blue, got 'rde'"),
        (Choices, {"either": "rde"}, "either must be one of red, blue, none, got 'rde'"),
        (Inherited, {"plain": "rde"}, "plain must be one of red, blue, got 'rde'"),
        (Inherited, {"more": 3}, "more must be one of 1, 2, got '3'"),
    ],
)
def test_a_choice_that_is_not_listed_is_named(cls: type, given: dict[str, Any], message: str):
    with pytest.raises(UserError) as error:
        cls(**given)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("values", "least", "message"),
    [
        ({"count": 0}, 1, "count must be at least 1, got 0"),
        ({"count": -1}, 0, "count must not be negative, got -1"),
        ({"counts": (3, 0)}, 1, r"counts must be at least 1, got \(3, 0\)"),
        ({"rate": float("nan")}, 0, "rate must be finite and not negative, got nan"),
        ({"rate": float("inf")}, 0, "rate must be finite and not negative, got inf"),
        ({"rate": -float("inf")}, 1, "rate must be finite and at least 1, got -inf"),
    ],
)
def test_numbers_below_a_bound_are_named(values: dict[str, Any], least: int, message: str):
    with pytest.raises(UserError, match=message):
        check_at_least(Numbers(**values), least, *values)


def test_the_bound_itself_and_absent_numbers_pass():
    check_at_least(Numbers(1, (1, 2), 1.0), 1, "count", "counts", "rate")
    check_at_least(Numbers(None, (), 0.0), 0, "count", "counts", "rate")
    check_positive(Numbers(None, rate=1e-9), "count", "rate")


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_numbers_that_are_not_positive_are_named(rate: float):
    with pytest.raises(UserError, match=f"rate must be positive, got {rate}"):
        check_positive(Numbers(rate=rate), "rate")
