"""Measures one line of a table: accuracy in both views on every test store, the inferred graph, the edge features."""

import resource
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.baselines.least_squares import SpringLeastSquares
from predictor.baselines.majority import MajorityGraph
from predictor.checkpoint import load_checkpoint
from predictor.data.store import EpisodeStore, read_store
from predictor.data.windows import Windows
from predictor.evaluation.accuracy import Tally, fitted_std_m
from predictor.evaluation.disentanglement import direct_r2, linear_r2
from predictor.evaluation.graph_accuracy import GraphTally, edge_entropy
from predictor.evaluation.outcomes import Outcome, run_windows
from predictor.evaluation.paper_tables import BURN_IN_STEPS, Line, Protocol, Sizes, Table
from predictor.graph import pair_mask
from predictor.support.errors import UserError

GRAPHS = ("dgvae", "dnri", "least-squares", "majority")
"""Models whose graph is scored."""
FEATURED = ("dgvae", "least-squares")
"""Models whose edge features are scored; those of the others are placeholders."""
PAIR_BUDGET = 60_000
"""Largest number of pairs × samples per batch; it limits memory for scenes of any size."""


def measure_line(
    table: Table, line: Line, data: Path, sizes: Sizes, checkpoint: Path | None, seed: int, device: str
) -> dict[str, Any]:
    """Returns the results of a line: parameters, and for each test store both views, graph and feature scores."""
    stores = {kind: read_store(data / name) for kind, name in table.tests.items()}
    spec = next(iter(stores.values())).info.spec
    forecaster: Any
    std_m: tuple[float, ...] = ()
    parameters = 0
    horizon_steps = table.protocol.horizon_steps
    if line.model == "constant-velocity":
        forecaster = ConstantVelocity(spec, horizon_steps)
    elif line.model == "constant-velocity-noise":
        forecaster = _fitted_noise(read_store(data / table.train), sizes, table.protocol)
    elif line.model == "majority":
        forecaster = MajorityGraph.fit(spec, horizon_steps, read_store(data / table.train).episodes)
    elif line.model == "least-squares":
        smallest = table.smallest_constant
        # it works on the CPU only
        forecaster, device = SpringLeastSquares(spec, horizon_steps, smallest_constant=smallest), "cpu"
    else:
        assert checkpoint is not None
        forecaster, info = load_checkpoint(checkpoint, device)
        std_m, parameters = info.std_m, sum(p.numel() for p in forecaster.parameters())
        for kind, store in stores.items():
            info.spec.check_compatible(store.info.spec, f"line '{line.key}'", f"store {data / table.tests[kind]}")
    results = {
        kind: _measure_store(forecaster, store, table, line, sizes, std_m, seed, device)
        for kind, store in stores.items()
    }
    return {"parameters": parameters, "tests": results}


def _fitted_noise(store: EpisodeStore, sizes: Sizes, protocol: Protocol) -> NoisyConstantVelocity:
    """Returns constant velocity with noise fitted to its errors on the training windows of the protocol."""
    spec, episodes = store.info.spec, store.episodes[: sizes.max_episodes or None]
    steps = protocol.train_horizon_steps
    windows = Windows(episodes, spec, 1, steps, steps, protocol.train_history_steps)
    straight = ConstantVelocity(spec, steps)
    outcomes = run_windows(straight, windows, np.arange(len(windows)), steps)
    return NoisyConstantVelocity.fit(spec, fitted_std_m(outcomes))


def protocol_indices(
    windows: Windows, stride: int, limit: int, seed: int, burn_in_steps: int = BURN_IN_STEPS
) -> np.ndarray:
    """Returns the windows whose burn-in ends at every `stride`-th step of an episode; at most `limit`, drawn evenly."""
    chosen = np.flatnonzero((windows.index[:, 1] - (burn_in_steps - 1)) % stride == 0)
    if limit and len(chosen) > limit:
        chosen = np.sort(np.random.default_rng(seed).permutation(chosen)[:limit])
    return chosen


def _measure_store(
    forecaster: Any,
    store: EpisodeStore,
    table: Table,
    line: Line,
    sizes: Sizes,
    std_m: tuple[float, ...],
    seed: int,
    device: str,
) -> dict[str, Any]:
    burn_in, horizon = table.protocol.burn_in_steps, table.protocol.horizon_steps
    try:
        windows = Windows(store.episodes, store.info.spec, burn_in, horizon, horizon, burn_in)
    except UserError as error:
        raise UserError(f"test store of '{store.info.source}' fits no window of the protocol: {error}") from error
    chosen = protocol_indices(windows, table.test_stride, sizes.test_windows, seed, burn_in)
    samples = line.num_samples
    horizon_only, whole = Tally(std_m), Tally(partial_agents=True)
    types = max(forecaster.num_edge_types, table.num_label_types)
    matched = bool(table.num_label_types) and not line.train.get("type_label_weight")
    graph, features, entropies = GraphTally(types), _Features(), []
    agents = [int(store.episodes[e].valid[t].sum()) for e, t in windows.index[chosen].tolist()]
    batch = max(1, min(256, PAIR_BUDGET // (max(agents, default=1) ** 2 * samples)))
    began = time.perf_counter()
    if device.startswith("cuda"):
        torch.cuda.reset_peak_memory_stats()
    for outcome in run_windows(
        forecaster, windows, chosen, horizon, samples, seed, batch, device,
        whole_sequence=True, keep_beliefs=True,
    ):  # fmt: skip
        whole.add(outcome)
        horizon_only.add(outcome.tail(horizon))
        assert outcome.edge_probs is not None and outcome.present is not None
        pairs = pair_mask(outcome.present)
        unused = outcome.edge_probs.new_zeros(*outcome.edge_probs.shape[:-1], types - outcome.edge_probs.shape[-1])
        graph.add(torch.cat([outcome.edge_probs, unused], dim=-1), _known_types(outcome, types), pairs)
        entropies.append(edge_entropy(outcome.edge_probs, pairs)[0][pairs].cpu())
        if line.model in FEATURED:
            features.add(outcome)
    result: dict[str, Any] = {
        "windows": len(chosen),
        "agents": {"min": min(agents), "median": float(np.median(agents)), "max": max(agents)},
        "horizon_only": asdict(horizon_only.accuracy(line.name)),
        "whole_sequence": asdict(whole.accuracy(line.name)),
        "graph": asdict(graph.results(matched)) if line.model in GRAPHS else None,
        "prior_entropy": float(torch.cat(entropies).mean()) if line.model in ("dgvae", "dnri") else None,
        "features": features.scores(),
        "seconds": time.perf_counter() - began,
        "peak_memory_mb": _peak_memory_mb(device),
    }
    return result


def _peak_memory_mb(device: str) -> float:
    """Returns the peak memory [MB] of the accelerator since measuring began, or of this process since it started."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _known_types(outcome: Outcome, num_types: int) -> torch.Tensor | None:
    """Returns the true types, limited to those that the model has."""
    return None if outcome.edge_types is None else outcome.edge_types.clamp(-1, num_types - 1)


class _Features:
    """Collects edge features and true attributes over all windows of one size."""

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
        """Computes R² of the first attribute on true edges, by the first dimension and by a linear regression."""
        if not self._features:
            return None
        features, truth, valid = (np.concatenate(x) for x in (self._features, self._truth, self._valid))
        return {
            "direct_r2": direct_r2(features[..., 0], truth, valid),
            "linear_r2": linear_r2(features, truth, valid),
        }
