"""Writes a checkpoint's model card: `python -m predictor.card --checkpoint DIR --data STORES --accuracy JSON`.

The card is made from files only (config, stores, measured accuracy). The measurements are also written to `in_env.json`
beside the weights, from which `docs/write_tables.py` writes the tables of README.md and docs/in_env.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from predictor.checkpoint import WEIGHTS, CheckpointInfo, load_checkpoint, name_of_folder, resolve
from predictor.data.store import EpisodeStore, read_store
from predictor.evaluation.in_env_record import measurements_of, read_record, updated, write_record
from predictor.forecaster import has_scale
from predictor.reports.in_env_tables import PLURAL, card_section
from predictor.reports.tables import MODEL_NAMES
from predictor.support.command_line import parse
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import write_text
from predictor.support.reading import read_object
from predictor.support.remote import require_local

SPREAD = {
    True: "Where a driver's route is free, the single forecast lies between the routes, and the modes follow them.",
    False: "The spread of its samples is not calibrated; where a driver's route is free, the forecast lies between the "
    "routes.",
}
"""What is said of the spread of a model with modes, and of one without."""


@dataclass(frozen=True)
class CardConfig:
    """Writes README.md and in_env.json into a checkpoint's folder."""

    checkpoint: Path
    """Checkpoint whose card is written: a folder or a run folder."""
    data: tuple[Path, ...]
    """Episode stores that the checkpoint was trained on."""
    accuracy: Path
    """File accuracy.json of `python -m envs.evaluate` with the results of this checkpoint."""


def write_card(config: CardConfig) -> Path:
    """Writes the card and the record of measurements; returns the card's path.

    Raises:
        UserError: an input is unreadable, the accuracy has no result for this checkpoint, or the checkpoint does not
            say how it was trained. Nothing is written then.
    """
    require_local(config.checkpoint, "checkpoint")
    model, info = load_checkpoint(config.checkpoint)
    folder, name = resolve(config.checkpoint), name_of_folder(config.checkpoint)
    try:
        accuracy = read_object(config.accuracy)
        found, first_seed = measurements_of(accuracy, name), int(accuracy["config"]["seed"])
        found = found or measurements_of(accuracy, folder.name)
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise UserError(f"{config.accuracy} is not an accuracy.json of envs.evaluate ({error})") from error
    if not found:
        raise UserError(f"{config.accuracy} has no result of checkpoint '{name}'; run envs.evaluate on it")
    opened = {path: read_store(path) for path in config.data}
    known = {path: store.info.source for path, store in opened.items()}
    others = [f"{path} has {source}" for path, source in known.items() if info.sources and source not in info.sources]
    missing = set(info.sources) - set(known.values())
    if others or missing or not opened:
        wanted, given = ", ".join(dict.fromkeys(info.sources)), "; ".join(others or known.values())
        raise UserError(f"data are the stores that '{name}' was trained on ({wanted}), got {given or 'none'}")
    stores = "\n".join(_store_line(path, store) for path, store in opened.items())
    training = _training(name, info)
    record = updated(read_record(folder), found)
    measured = [m for m in record if m.samples == found[0].samples]
    ego = "the ego included" if info.spec.has_ego else "no ego"
    left_out = "the ego itself is not counted" if info.spec.has_ego else "what never moves is not counted"
    plural = has_scale(model)
    kind, parameters = MODEL_NAMES.get(info.model, info.model), sum(p.numel() for p in model.parameters())
    kind = PLURAL if plural else kind
    size_kb = (folder / WEIGHTS).stat().st_size / 1000
    text = "\n\n".join(
        [
            f"# Predictor checkpoint `{name}`",
            f"{kind.replace('plural', 'Plural')}, {parameters:,} parameters, {size_kb:.0f} kB of safetensors. "
            f"Trained on recorded {', '.join(dict.fromkeys(info.sources))}; forecasts {info.horizon_steps} steps of "
            f"{info.spec.dt_s:g} s. Sees at most {info.spec.max_agents} agents ({ego}) within "
            f"{info.spec.perception_m:g} m.",
            "## Accuracy in the live environment",
            f"Held-out seeds from {first_seed:,}; {left_out}. minADE₁ is the error of the single forecast (K = 1); "
            "neighbours: memoryless nearest neighbours on the training data. Intervals: bootstrap over episodes.",
            f"<!-- table: accuracy -->\n\n{card_section(measured, kind)}\n\n<!-- end -->",
            "## Data",
            stores,
            "## Training",
            training,
            "## Limits",
            "It knows the traffic of the simulator named above and nothing else: fixed maps are memorised, drivers are "
            f"those of the simulator. {SPREAD[plural]} It was trained without a view of the ego's plan.",
        ]
    )
    path = folder / "README.md"
    write_record(folder, record)  # only now that the card is made: a new record beside an old card would contradict it
    write_text(path, text + "\n")
    return path


def _store_line(path: Path, store: EpisodeStore) -> str:
    made = store.info.provenance
    return f"* {store.info.source}: {len(store.episodes)} episodes, {store.num_steps} scenes. `{made.get('command')}`"


def _training(name: str, info: CheckpointInfo) -> str:
    try:
        spread = info.provenance.get("spread")
        return _trained(info.provenance) + (_spread(spread) if spread else "")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"checkpoint '{name}' does not say how it was trained; write cards of checkpoints of predictor.train"
        ) from error


def _trained(made: Mapping[str, Any]) -> str:
    result = made["result"]
    chosen = "Last" if made["train_config"].get("keep") == "last" else "Best"
    reached = f"energy score {result['val_energy_m']:.3f} m, ADE {result['val_ade_m']:.3f} m"
    versions = ", ".join(f"{k} {v}" for k, v in made["versions"].items())
    return (
        f"`{made['command']}`\n\nSeed {made['train_config']['seed']}, commit {made['commit']}, {versions}. {chosen} "
        f"validation at step {result['step']}: {reached} against "
        f"{result['val_constant_velocity_ade_m']:.3f} m of constant velocity. Equal seeds give equal weights on "
        "the same CPU and torch."
    )


def _spread(made: Mapping[str, Any]) -> str:
    result, config = made["result"], made["train_config"]
    return (
        f"\n\nThe spread of its modes was then trained alone, which moves no forecast: `{made['command']}`, seed "
        f"{config['seed']}, commit {made['commit']}. Best validation at step {result['step']}: negative log-likelihood "
        f"{result['val_mixture_nll']:.2f} nats."
    )


def main() -> None:
    """Entry point."""
    print(write_card(parse(CardConfig, __doc__)))


if __name__ == "__main__":
    run_entry_point(main)
