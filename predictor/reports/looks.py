"""Looks of plots: one style, and one colour for each kind of forecaster wherever it is drawn.

Colours are those of Okabe and Ito, which colour-blind readers tell apart; black is the truth, grey constant velocity.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any

from cycler import cycler

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#7f7f7f", "#8c564b", "#9467bd")
"""Colours of lines, in the order of their use; the first eight differ for colour-blind readers, too."""
BLUE, ORANGE, GREEN, PINK, YELLOW, SKY, BLACK, GREY, BROWN, PURPLE = COLORS
DASHES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5, 1, 1.5)), (0, (2, 3)))

AS_TEXT: Any = {"text.parse_math": False}
"""Matplotlib's setting for names from files, which may hold dollars and are no formulas."""
STYLE: Any = AS_TEXT | {
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=COLORS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "legend.handlelength": 3.6,  # the longest dashes, twice
}
"""Matplotlib's settings of every plot: `@rc_context(STYLE)`."""

_FAMILIES = {
    "constant velocity": GREY,
    "nearest neighbours": GREEN,
    "dg-vae (paper)": PURPLE,
    "dg-vae": BLUE,
    "dvae": SKY,
    "dnri": ORANGE,
    "imma": PINK,
    "lstm": YELLOW,
    "mlp": BROWN,
    "least squares": BLACK,
}
"""Colour by a part of the name, in the order of search."""
_OTHERS = (BLUE, ORANGE, PINK, YELLOW, PURPLE, SKY, BROWN)
"""Colours of names without a family: checkpoints, of which the first is the one that the plot is about."""


def looks_of(names: Iterable[str]) -> list[dict[str, Any]]:
    """Returns colour and dashes of each line of a plot, as keyword arguments; members of a family differ by dashes."""
    used: Counter[str] = Counter()
    found, others = [], 0
    for name in names:
        color = next((color for part, color in _FAMILIES.items() if part in name.lower()), None)
        if color is None:
            color, others = _OTHERS[others % len(_OTHERS)], others + 1
        found.append({"color": color, "ls": DASHES[used[color] % len(DASHES)]})
        used[color] += 1
    return found
