"""Writes the golden files of the package's version: `python -m tests.golden.make`; what is there stays as it is.

A folder per version, `tests/golden/VERSION/`: an episode store with all that a store can hold, a tiny checkpoint of
each network, and what each forecasts on that store. `test_golden.py` reads those of all versions.
"""

import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from predictor.checkpoint import CheckpointInfo, load_checkpoint, save_checkpoint
from predictor.data.store import Episode, StoreInfo, read_store, write_store
from predictor.data.windows import Windows
from predictor.evaluation.outcomes import run_window_batch
from tests.predictor.helpers import any_model, circling_episode, spec

HERE = Path(__file__).parent
MODELS = {
    "dgvae": "dgvae", "dgvae-plural-rich": "dgvae", "dnri": "dnri", "imma": "imma", "lstm-joint": "lstm", "mlp": "mlp",
}  # fmt: skip
"""Networks, with their names in checkpoints."""
HISTORY_STEPS, HORIZON_STEPS, NUM_SAMPLES = 4, 3, 2


def golden_episode(seed: int) -> Episode:
    """Returns an episode with edge labels, causal labels and perturbations."""
    episode, rng = circling_episode(seed, agents=3), np.random.default_rng(seed)
    steps, agents = episode.valid.shape
    valid = episode.valid.copy()
    valid[:2, -1] = False  # an agent that enters later
    perturbed = np.zeros((steps, agents), dtype=np.int8)
    perturbed[-2:, 1] = 1  # windows that see its beginning are left out
    return replace(
        episode,
        states=np.where(valid[..., None], episode.states, 0).astype(np.float32),
        valid=valid,
        edge_types=rng.integers(-1, 2, size=(steps, agents, agents)).astype(np.int8),
        edge_attributes=rng.normal(size=(steps, agents, agents, 1)).astype(np.float32),
        causal_shift_m=rng.uniform(size=(steps, agents, agents)).astype(np.float32),
        perturbed=perturbed,
    )


def forecasts(folder: Path, name: str) -> list[list[float]]:
    """Returns what a golden checkpoint forecasts on the golden store: a line of numbers for each window [m]."""
    model, _ = load_checkpoint(folder / "checkpoints" / name)
    store = read_store(folder / "store")
    windows = Windows(store.episodes, store.info.spec, HISTORY_STEPS, HORIZON_STEPS)
    with torch.no_grad():
        generator = torch.Generator().manual_seed(0)
        outcome = run_window_batch(model, windows.batch(np.arange(len(windows))), HORIZON_STEPS, NUM_SAMPLES, generator)
    shown = outcome.forecast * outcome.valid.any(-1)[:, None, :, None, None]  # of agents that are there
    found: list[list[float]] = shown.flatten(1).double().tolist()
    return found


def main() -> None:
    """Entry point."""
    folder = HERE / version("dgvae-rl")
    if folder.exists():
        raise SystemExit(f"{folder} exists and stays as it is")
    made: dict[str, Any] = {"seed": 0}
    info = StoreInfo(spec(), "golden", made, ("gap_m",), causal_threshold_m=0.5)
    write_store(folder / "store", info, [golden_episode(seed) for seed in range(2)])
    for name, model in MODELS.items():
        network = any_model(name)
        note = CheckpointInfo(network.spec, network.config, HORIZON_STEPS, (0.5, 0.6, 0.7), ("golden",), made, model)
        save_checkpoint(folder / "checkpoints" / name, network, note)
    expected = {name: forecasts(folder, name) for name in MODELS}
    (folder / "forecasts.json").write_text(json.dumps(expected).replace("]]", "]]\n"))


if __name__ == "__main__":
    main()
