"""Curve of a training: `curve.json` of a run folder, with a point for each validation."""

import os
from pathlib import Path

from predictor.support.errors import UserError
from predictor.support.files import finite, write_json
from predictor.support.reading import damage_in, read_json
from predictor.support.typed_values import converted

CURVE_FILE = "curve.json"
KEYS = ("energy_m", "ade_m", "fde_m", "min_ade_m", "min_joint_ade_m", "constant_velocity_ade_m")
"""What a point holds beside its step: errors on the validation episodes [m]."""

Point = dict[str, int | float]
"""Step and errors [m] of a validation; what is not finite is NaN."""


def read_curve(path: Path) -> list[Point]:
    """Reads the points of a training, in the order of their steps; none if there is no such file.

    Raises:
        UserError: the file is damaged.
    """
    if not os.path.lexists(path):
        return []
    try:
        entries = converted(read_json(path), tuple[dict[str, float | None], ...], str(path))
        points = []
        for number, entry in enumerate(entries):
            missing = [key for key in ("step", *KEYS) if key not in entry]
            if missing:
                raise UserError(f"{path}: point {number + 1}: key '{missing[0]}' is missing")
            points.append({key: float("nan") if value is None else value for key, value in entry.items()})
    except UserError as error:
        raise UserError(f"{path} is damaged; remove it to go on without it ({damage_in(path, error)})") from error
    return points


def add_point(path: Path, point: Point) -> None:
    """Writes a point behind those of earlier steps; later ones are of a run that was continued from before them."""
    earlier = [known for known in read_curve(path) if known["step"] < point["step"]]
    write_json(path, finite([*earlier, point]))
