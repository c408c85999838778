"""Writes the tables of README.md, docs/ and the checkpoints' cards: `python -m docs.write_tables [--check]`.

Numbers come from records, predictor/pretrained/NAME/in_env.json, which `python -m predictor.card` fills; sizes from the
checkpoints themselves. Tables stand between `<!-- table: NAME -->` and `<!-- end -->`. With `--check` nothing is
written: the exit status is 1 if a page differs from its records.
"""

import sys
from pathlib import Path

from envs.registry import CHECKPOINTS, MULTIAGENT_CHECKPOINTS
from predictor.checkpoint import PRETRAINED as CHECKPOINT_FOLDER
from predictor.checkpoint import WEIGHTS, load_checkpoint
from predictor.evaluation.in_env_record import FILE_NAME, Measurement, read_record
from predictor.reports.in_env_tables import (
    card_section,
    measurement_table,
    replace_tables,
    samples_table,
)
from predictor.reports.tables import metres
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import write_text
from predictor.support.markdown import table

ROOT = Path(__file__).resolve().parents[1]
PRETRAINED = Path("predictor/pretrained")
PAGES = (Path("README.md"), Path("docs/checkpoints.md"), Path("docs/in_env.md"))
SERVED_BY = CHECKPOINTS | MULTIAGENT_CHECKPOINTS
"""Id → checkpoint that ships for it, in the order of the tables."""
SAMPLES = 20
"""Number of samples K of the tables by environment; the transfer matrix has K = 1, the single forecast alone."""

FIRST = ("highway-fast-v0", "merge-v1", "roundabout-v1", "intersection-v2", "racetrack-v1", "simple_tag_v3")
"""Ids of the table of README.md: one of each kind."""
SHORT = (
    "env", "driver", "episodes", "horizon", "minADE₁ / minFDE₁ [m]", "nearest neighbours ADE [m]",
    "constant velocity ADE / FDE [m]", "ADE below constant velocity (95 %)", "forecasts",
)  # fmt: skip
SIZES = ("checkpoint", "serves", "parameters", "size [kB]", "modes", "horizon", "agents", "range [m]")
LONG = (
    "env", "driver", "episodes", "K", "horizon", "minADE₁ (95 %) / minFDE₁ [m]", "best of K [m]",
    "one step of history (95 %) [m]", "nearest neighbours ADE [m]", "constant velocity ADE / FDE [m]",
    "ADE below constant velocity (95 %)", "latency median / p95 [ms]", "forecasts",
)  # fmt: skip

Records = dict[str, list[Measurement]]
"""Measurements by the name of the checkpoint."""


def tables(records: Records) -> dict[str, str]:
    """Returns the tables of README.md and docs/ by name."""
    at_k = {name: [m for m in found if m.samples == SAMPLES] for name, found in records.items()}
    own = [m for env_id, name in SERVED_BY.items() for m in at_k.get(name, []) if m.env_id == env_id]
    return {
        "first": measurement_table([m for m in own if m.env_id in FIRST], SHORT),
        "checkpoints": _sizes(),
        "forecasts": measurement_table(own, SHORT),
        "forecasts-long": measurement_table(own, LONG),
        "samples": samples_table(own),
        "transfer": _transfer(records),
    }


def pages(root: Path) -> dict[Path, tuple[str, str]]:
    """Returns every page with tables as it is, and as the records say.

    Raises:
        UserError: a record cannot be read or lacks a measurement, or a page marks a table that is not known.
    """
    folders = sorted(path.parent for path in (root / PRETRAINED).glob(f"*/{FILE_NAME}"))
    records = {folder.name: read_record(folder) for folder in folders}
    found = {}
    written = tables(records)
    for path in PAGES:
        page = (root / path).read_text()
        found[path] = page, replace_tables(page, written)
    for name, measurements in records.items():
        path = PRETRAINED / name / "README.md"
        page = (root / path).read_text()
        shown = [m for m in measurements if m.samples == SAMPLES]
        found[path] = page, replace_tables(page, {"accuracy": card_section(shown)})
    return found


def _sizes() -> str:
    """Returns the table of what ships: a checkpoint's card, the ids it serves, its size, and what it forecasts."""
    lines = []
    for name in sorted(set(SERVED_BY.values())):
        model, info = load_checkpoint(name)
        modes, card = getattr(info.config, "num_modes", 0), f"../{PRETRAINED}/{name}/README.md"
        lines.append(
            [
                f"[{name}]({card})",
                ", ".join(env_id for env_id, serving in SERVED_BY.items() if serving == name),
                f"{sum(weights.numel() for weights in model.parameters()):,}",
                f"{(CHECKPOINT_FOLDER / name / WEIGHTS).stat().st_size / 1000:.0f}",
                str(modes) if modes else "–",
                f"{info.horizon_steps} × {info.spec.dt_s:g} s",
                str(info.spec.max_agents),
                f"{info.spec.perception_m:g}",
            ]
        )
    return table(SIZES, lines, "--r")


def _transfer(records: Records) -> str:
    """Returns minADE₁ of each checkpoint (columns) in each environment (lines), and how far below constant velocity."""
    single = [(m.env_id, name, m) for name, found in records.items() for m in found if m.samples == 1]
    measured = {(env_id, name): m for env_id, name, m in single}
    if len(measured) < len(single):
        raise UserError("transfer: a checkpoint has two measurements with K = 1 in one environment; keep one driver's")
    names = sorted({name for _, name in measured})
    lines = []
    for env_id in sorted({env_id for env_id, _ in measured}):
        missing = [name for name in names if (env_id, name) not in measured]
        if missing:
            raise UserError(
                f"transfer to {env_id}: no measurement with K = 1 in the records of {', '.join(missing)}; measure it "
                "with envs.evaluate --num-samples 1, and record it with predictor.card"
            )
        found = [measured[env_id, name] for name in names]
        episodes = {m.episodes for m in found}
        if len(episodes) > 1:
            raise UserError(f"transfer to {env_id}: lines need equal episodes, got {sorted(episodes)}; measure again")
        cells = [f"{metres(m.min_ade_m)} ({100 * (m.below_cv or 0):.0f} %)" for m in found]
        lines.append([env_id, str(episodes.pop()), *cells])
    return table(["env", "episodes", *names], lines, "-r")


def main() -> None:
    """Runs the command."""
    arguments = sys.argv[1:]
    if arguments not in ([], ["--check"]):
        raise UserError(f"write_tables takes --check or nothing, got {' '.join(arguments)}")
    changed = {path: new for path, (old, new) in pages(ROOT).items() if new != old}
    if arguments and changed:
        raise UserError(f"{', '.join(map(str, changed))} differ from the records; run python -m docs.write_tables")
    for path, text in changed.items():
        write_text(ROOT / path, text)
    print(f"{len(changed)} pages rewritten" if changed else "all tables are as the records say")


if __name__ == "__main__":
    run_entry_point(main)
