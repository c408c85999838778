"""Predictor checkpoints on a Hugging Face hub: `push_to_hub("runs/merge", "owner/name")`, `from_hub("owner/name")`.

What is shared is the two files of a checkpoint and its card. They hold no code: a checkpoint of a stranger is read as
one on disk is, within bounds (docs/security.md). The extra "hub" brings the package huggingface_hub.
"""

from pathlib import Path
from typing import Any

from predictor.checkpoint import (
    BEST_OF_RUN,
    CARD,
    CONFIG,
    MOST_CARD_BYTES,
    WEIGHTS,
    CheckpointInfo,
    load_checkpoint,
    name_of_folder,
    resolve,
)  # fmt: skip
from predictor.reports.tables import MODEL_NAMES
from predictor.support.errors import UserError
from predictor.support.hub import PREFIX, hub_name, is_hub, push
from predictor.support.reading import NoSuchFile, read_text
from predictor.support.remote import is_remote

_HEADER = "---\nlibrary_name: dgvae-rl\ntags:\n- trajectory-prediction\n- dgvae-rl\n---\n\n"


def push_to_hub(checkpoint: str | Path, repository: str, private: bool = False) -> str:
    """Writes a checkpoint into a repository of the hub; returns the repository's address.

    Args:
        checkpoint: shipped name, folder or run folder of `python -m predictor.train`.
        repository: owner and name, as "owner/name"; a new one is made if it does not exist.
        private: whether a new repository is private.

    Raises:
        UserError: no such checkpoint, or one that is damaged; the extra is missing, or the hub refuses.
    """
    if is_hub(checkpoint):
        raise UserError(f"{checkpoint} is on a hub already; push a folder")
    _, info = load_checkpoint(checkpoint)  # what is not whole is not shared
    folder = resolve(checkpoint)
    text = _card(checkpoint, folder) or card_of(name_of_folder(checkpoint), repository, info)
    if not text.startswith("---"):
        text = _HEADER + text
    content: dict[str, bytes | Path] = {name: folder / name for name in (CONFIG, WEIGHTS)}
    content[CARD] = text.encode()
    return push(folder, repository, private, f"Checkpoint {name_of_folder(checkpoint)}", content)


def _card(checkpoint: str | Path, folder: Path) -> str:
    """Returns the card of a checkpoint; empty without one. Of an address, `folder` is a copy of the other files."""
    places = [folder] if not is_remote(checkpoint) else [Path(checkpoint), Path(checkpoint) / BEST_OF_RUN]
    for place in places:
        try:
            return read_text(place / CARD, MOST_CARD_BYTES)
        except NoSuchFile:
            continue
    return ""


def from_hub(name: str, device: str = "cpu") -> tuple[Any, CheckpointInfo]:
    """Downloads a checkpoint and loads its model for inference.

    Args:
        name: "owner/name", or "owner/name@revision" for a branch, tag or commit; "hub:" may stand before it.
        device: device of the model.

    Raises:
        UserError: the hub does not give it, or it is no predictor checkpoint.
    """
    return load_checkpoint(str(hub_name(name if is_hub(name) else f"{PREFIX}{name}")), device)


def card_of(name: str, repository: str, info: CheckpointInfo) -> str:
    """Returns a short card for a checkpoint that has none; `python -m predictor.card` writes a longer one."""
    result = info.provenance.get("result")
    reached = result.get("val_ade_m") if isinstance(result, dict) else None
    lines = [
        f"# Predictor checkpoint `{name}`",
        f"{MODEL_NAMES.get(info.model, info.model)}, trained on recorded {', '.join(info.sources) or 'data'}; "
        f"forecasts {info.horizon_steps} steps of {info.spec.dt_s:g} s for at most {info.spec.max_agents} agents "
        f"within {info.spec.perception_m:g} m.",
        f"Best validation: ADE {reached:.3f} m." if isinstance(reached, float) else "",
        f"```python\nfrom dgvae_rl import ForecastObservation\n\n"
        f'env = ForecastObservation(env, "hub:{repository.removeprefix(PREFIX)}")\n```',
        "Safetensors and JSON; it holds no code.",
    ]
    return "\n\n".join(filter(None, lines)) + "\n"
