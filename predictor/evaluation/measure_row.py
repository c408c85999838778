"""Measures one row of a table: accuracy in both views on every test store, the inferred graph, the edge features."""

import resource
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.baselines.least_squares import SpringLeastSquares
from predictor.checkpoint import load_checkpoint
from predictor.data.store import EpisodeStore, read_store
from predictor.data.windows import Windows
from predictor.evaluation.accuracy import Tally, fitted_std_m
from predictor.evaluation.disentanglement import direct_r2, linear_r2
from predictor.evaluation.graph_accuracy import GraphTally, edge_entropy
from predictor.evaluation.outcomes import Outcome, run_windows
from predictor.evaluation.paper_tables import BURN_IN_STEPS, HORIZON_STEPS, Row, Sizes, Table
from predictor.graph import pair_mask
from predictor.support.errors import UserError

PAIR_BUDGET = 60_000
"""Pairs × samples per batch: what keeps memory small for scenes of any size."""


def measure_row(
    table: Table, row: Row, data: Path, sizes: Sizes, checkpoint: Path | None, seed: int, device: str
) -> dict[str, Any]:
    """Results of a row: parameters, and for each test store both views, graph and feature scores."""
    stores = {kind: read_store(data / name) for kind, name in table.tests.items()}
    spec = next(iter(stores.values())).info.spec
    forecaster: Any
    std_m: tuple[float, ...] = ()
    parameters = 0
    if row.model == "constant-velocity":
        forecaster = ConstantVelocity(spec, HORIZON_STEPS)
    elif row.model == "constant-velocity-noise":
        forecaster = _fitted_noise(read_store(data / table.train), sizes)
    elif row.model == "least-squares":
        forecaster = SpringLeastSquares(spec, HORIZON_STEPS)
    else:
        assert checkpoint is not None
        forecaster, info = load_checkpoint(checkpoint, device)
        std_m, parameters = info.std_m, sum(p.numel() for p in forecaster.parameters())
        for kind, store in stores.items():
            info.spec.check_compatible(store.info.spec, f"row '{row.key}'", f"store {data / table.tests[kind]}")
    results = {
        kind: _measure_store(forecaster, store, table, row, sizes, std_m, seed, device)
        for kind, store in stores.items()
    }
    return {"parameters": parameters, "tests": results}


def _fitted_noise(store: EpisodeStore, sizes: Sizes) -> NoisyConstantVelocity:
    """Returns constant velocity with noise fitted to its errors on the training windows of the protocol."""
    spec, episodes = store.info.spec, store.episodes[: sizes.max_episodes or None]
    windows = Windows(episodes, spec, 1, HORIZON_STEPS, HORIZON_STEPS, BURN_IN_STEPS)
    straight = ConstantVelocity(spec, HORIZON_STEPS)
    outcomes = run_windows(straight, windows, np.arange(len(windows)), HORIZON_STEPS)
    return NoisyConstantVelocity.fit(spec, fitted_std_m(outcomes))


def protocol_indices(windows: Windows, stride: int, limit: int, seed: int) -> np.ndarray:
    """Windows that end their burn-in at every `stride`-th step of an episode; `limit` of them, drawn evenly."""
    chosen = np.flatnonzero((windows.index[:, 1] - (BURN_IN_STEPS - 1)) % stride == 0)
    if limit and len(chosen) > limit:
        chosen = np.sort(np.random.default_rng(seed).permutation(chosen)[:limit])
    return chosen


def _measure_store(
    forecaster: Any,
    store: EpisodeStore,
    table: Table,
    row: Row,
    sizes: Sizes,
    std_m: tuple[float, ...],
    seed: int,
    device: str,
) -> dict[str, Any]:
    try:
        windows = Windows(store.episodes, store.info.spec, BURN_IN_STEPS, HORIZON_STEPS, HORIZON_STEPS, BURN_IN_STEPS)
    except UserError as error:
        raise UserError(f"test store of '{store.info.source}' fits no window of the protocol: {error}") from error
    chosen = protocol_indices(windows, table.test_stride, sizes.test_windows, seed)
    samples = row.num_samples
    horizon_only, whole = Tally(std_m), Tally(partial_agents=True)
    graph, features, entropies = GraphTally(forecaster.num_edge_types), _Features(), []
    agents = [int(store.episodes[e].valid[t].sum()) for e, t in windows.index[chosen].tolist()]
    batch = max(1, min(256, PAIR_BUDGET // (max(agents, default=1) ** 2 * samples)))
    began = time.perf_counter()
    if device.startswith("cuda"):
        torch.cuda.reset_peak_memory_stats()
    for outcome in run_windows(
        forecaster, windows, chosen, HORIZON_STEPS, samples, seed, batch, device,
        whole_sequence=True, keep_beliefs=True,
    ):  # fmt: skip
        whole.add(outcome)
        horizon_only.add(outcome.tail(HORIZON_STEPS))
        assert outcome.edge_probs is not None and outcome.present is not None
        pairs = pair_mask(outcome.present)
        graph.add(outcome.edge_probs, _binary(outcome, forecaster.num_edge_types), pairs)
        entropies.append(edge_entropy(outcome.edge_probs, pairs)[0][pairs].cpu())
        if row.model in ("dgvae", "least-squares"):  # the others' features are placeholders
            features.add(outcome)
    result: dict[str, Any] = {
        "windows": len(chosen),
        "agents": {"min": min(agents), "median": float(np.median(agents)), "max": max(agents)},
        "horizon_only": asdict(horizon_only.accuracy(row.name)),
        "whole_sequence": asdict(whole.accuracy(row.name)),
        "graph": asdict(graph.results()) if row.model in ("dgvae", "dnri", "least-squares") else None,
        "prior_entropy": float(torch.cat(entropies).mean()) if row.model in ("dgvae", "dnri") else None,
        "features": features.scores(),
        "seconds": time.perf_counter() - began,
        "peak_memory_mb": _peak_memory_mb(device),
    }
    return result


def _peak_memory_mb(device: str) -> float:
    """Of the accelerator since measuring began, or of this process since it started."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _binary(outcome: Outcome, num_types: int) -> torch.Tensor | None:
    """True types, as far as the model tells them apart."""
    return None if outcome.edge_types is None else outcome.edge_types.clamp(-1, num_types - 1)


class _Features:
    """Edge features beside true attributes, over all windows of one size."""

    def __init__(self) -> None:
        self._features: list[np.ndarray] = []
        self._truth: list[np.ndarray] = []
        self._valid: list[np.ndarray] = []

    def add(self, outcome: Outcome) -> None:
        if outcome.edge_attributes is None or outcome.edge_features is None or not outcome.edge_features.shape[-1]:
            return
        assert outcome.present is not None
        valid = pair_mask(outcome.present)
        if outcome.edge_types is not None:
            valid = valid & (outcome.edge_types > 0)
        self._features.append(outcome.edge_features.cpu().numpy())
        self._truth.append(outcome.edge_attributes[..., 0].cpu().numpy())
        self._valid.append(valid.cpu().numpy())

    def scores(self) -> dict[str, Any] | None:
        """R² of the first attribute on true edges: from the first dimension as it is, and by a linear read-out."""
        if not self._features:
            return None
        features, truth, valid = (np.concatenate(x) for x in (self._features, self._truth, self._valid))
        return {
            "direct_r2": direct_r2(features[..., 0], truth, valid),
            "linear_r2": linear_r2(features, truth, valid),
        }
