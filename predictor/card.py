"""Write a checkpoint's model card: `python -m predictor.card --checkpoint DIR --data STORES --accuracy JSON`.

The card is made from what the files say of themselves (config, stores, measured accuracy); nothing is typed in by hand.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from predictor.checkpoint import WEIGHTS, CheckpointInfo, load_checkpoint, name_of_folder, resolve
from predictor.command_line import parse
from predictor.data.store import EpisodeStore, read_store
from predictor.errors import UserError, run_entry_point
from predictor.files import write_text
from predictor.markdown import table


@dataclass(frozen=True)
class CardConfig:
    """Write README.md into a checkpoint's folder."""

    checkpoint: Path
    """Checkpoint whose card is written: a folder or a run folder."""
    data: tuple[Path, ...]
    """Episode stores that the checkpoint was trained on."""
    accuracy: Path
    """File accuracy.json of `python -m envs.evaluate` with the results of this checkpoint."""


def write_card(config: CardConfig) -> Path:
    """Write the card; returns its path.

    Raises:
        UserError: unreadable input, or no accuracy row for this checkpoint.
    """
    model, info = load_checkpoint(config.checkpoint)
    folder, name = resolve(config.checkpoint), name_of_folder(config.checkpoint)
    try:
        results = json.loads(config.accuracy.read_text())
        rows = [r for r in results["results"] if r["checkpoint"] in (name, folder.name)]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{config.accuracy} is not an accuracy.json of envs.evaluate ({error})") from error
    if not rows:
        raise UserError(f"{config.accuracy} has no row for checkpoint '{name}'; run envs.evaluate on it")
    who = "the ego included" if info.spec.has_ego else "nobody is the ego"
    drivers = ", ".join(sorted({f"`{r.get('driver') or results['config']['ego']}`" for r in rows}))
    left_out = "the ego itself is not counted" if info.spec.has_ego else "what never moves is not counted"
    parameters = sum(p.numel() for p in model.parameters())
    size_kb = (folder / WEIGHTS).stat().st_size / 1000
    text = "\n\n".join(
        [
            f"# Predictor checkpoint `{name}`",
            f"dG-VAE, {parameters:,} parameters, {size_kb:.0f} kB of safetensors. Trained on recorded "
            f"{', '.join(info.sources)}; forecasts {info.horizon_steps} steps of {info.spec.dt_s:g} s. Sees at most "
            f"{info.spec.max_agents} agents ({who}) within {info.spec.perception_m:g} m.",
            "## Accuracy in the live environment",
            f"Held-out seeds from {results['config']['seed']:,}, {results['config']['episodes']} episodes each, driven "
            f"{drivers}; {left_out}. minADE₁ is the most likely forecast, minADE_K the best of "
            f"{results['config']['samples']} samples; neighbours: memoryless nearest neighbours on the training data. "
            "Interval: bootstrap over episodes.",
            _accuracy(rows),
            f"Command: `{results['provenance']['command']}`",
            "## Data",
            "\n".join(_store_line(path, read_store(path)) for path in config.data),
            "## Training",
            _training(info),
            "## Limits",
            "Knows the traffic of the simulator named above and nothing else: fixed maps are learned by heart, drivers "
            "are the simulator's own. The spread of its samples is not calibrated; where a driver's route is free, the "
            "forecast lies between the routes. It was trained without a view of the ego's plan.",
        ]
    )
    path = folder / "README.md"
    write_text(path, text + "\n")
    return path


def _accuracy(rows: Sequence[dict[str, Any]]) -> str:
    headings = ["env", "minADE₁ [m]", "minFDE₁ [m]", "minADE_K [m]", "neighbours ADE [m]", "CV ADE / FDE [m]"]
    lines = []
    for row in rows:
        one, straight = row["model"], row["constant_velocity"]
        low, high = row["reduction_interval"]
        near = row.get("nearest_neighbours")
        lines.append(
            [
                row["env_id"],
                _metres(one["min_ade_m"]),
                _metres(one["min_fde_m"]),
                _metres(row["model_samples"]["min_ade_m"]),
                "–" if near is None else _metres(near["min_ade_m"]),
                f"{_metres(straight['min_ade_m'])} / {_metres(straight['min_fde_m'])}",
                f"{100 * row['reduction']:.0f} %",
                f"{100 * low:.0f} to {100 * high:.0f} %",
            ]
        )
    return table([*headings, "below CV", "95 % interval"], lines)


def _metres(value: float) -> str:
    return f"{value:.2f}" if value >= 1 else f"{value:.3f}"


def _store_line(path: Path, store: EpisodeStore) -> str:
    made = store.info.provenance
    return f"* {store.info.source}: {len(store.episodes)} episodes, {store.num_steps} scenes. `{made.get('command')}`"


def _training(info: CheckpointInfo) -> str:
    made, result = info.provenance, info.provenance["result"]
    versions = ", ".join(f"{k} {v}" for k, v in made["versions"].items())
    return (
        f"`{made['command']}`\n\nSeed {made['train_config']['seed']}, commit {made['commit']}, {versions}. Best "
        f"validation at step {result['step']}: minADE {result['val_min_ade_m']:.3f} m against "
        f"{result['val_constant_velocity_ade_m']:.3f} m of constant velocity. Equal seeds give equal weights on "
        "the same CPU and torch."
    )


def main() -> None:
    """Entry point."""
    print(write_card(parse(CardConfig, __doc__)))


if __name__ == "__main__":
    run_entry_point(main)
