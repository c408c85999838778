"""Measures one line of a table: accuracy in both views on every test store, the inferred graph, the edge features."""

import resource
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from predictor.baselines.constant_velocity import NoisyConstantVelocity
from predictor.baselines.gaussian_residual import GaussianResidual
from predictor.data.store import EpisodeStore, read_store
from predictor.data.windows import Windows
from predictor.evaluation.accuracy import Tally
from predictor.evaluation.disentanglement import direct_r2, linear_r2
from predictor.evaluation.displacement import MISS_THRESHOLD_M
from predictor.evaluation.graph_accuracy import GraphTally, edge_entropy
from predictor.evaluation.line_forecasters import LineForecaster, batch_size, line_forecaster
from predictor.evaluation.outcomes import Outcome, run_windows
from predictor.evaluation.paper_tables import BURN_IN_STEPS, NUM_SAMPLES, Line, PaperTable, Sizes
from predictor.graph import pair_mask
from predictor.support.errors import UserError

GRAPHS = ("dgvae", "dnri", "least-squares", "majority")
"""Models whose graph is scored."""
FEATURED = ("dgvae", "least-squares")
"""Models whose edge features are scored; those of the others are placeholders."""
WINDOWS_SEED = 0
"""Random seed of the test windows, the same for all training seeds."""


def measure_line(
    table: PaperTable, line: Line, data: Path, sizes: Sizes, checkpoint: Path | None, seed: int, device: str
) -> dict[str, Any]:
    """Returns the results of a line: parameters, what was fitted, and for each test store both views and scores."""
    stores = {kind: read_store(data / name) for kind, name in table.tests.items()}
    spec = next(iter(stores.values())).info.spec
    made = line_forecaster(table, line, data, sizes, checkpoint, spec, device)
    for kind, store in stores.items():
        made.forecaster.spec.check_recorded(store.info.spec, f"line '{line.key}'", f"store {data / table.tests[kind]}")
    results = {kind: _measure_store(made, store, table, line, sizes, seed) for kind, store in stores.items()}
    return {"parameters": made.parameters, "fitted": made.fitted, "tests": results}


def protocol_indices(
    windows: Windows, stride: int, limit: int, seed: int, burn_in_steps: int = BURN_IN_STEPS
) -> np.ndarray:
    """Returns the windows whose burn-in ends at every `stride`-th step of an episode; at most `limit`, drawn evenly."""
    chosen = np.flatnonzero((windows.index[:, 1] - (burn_in_steps - 1)) % stride == 0)
    if limit and len(chosen) > limit:
        chosen = np.sort(np.random.default_rng(seed).permutation(chosen)[:limit])
    return chosen


def _measure_store(
    made: LineForecaster, store: EpisodeStore, table: PaperTable, line: Line, sizes: Sizes, seed: int
) -> dict[str, Any]:
    burn_in, horizon = table.protocol.burn_in_steps, table.protocol.horizon_steps
    try:
        windows = Windows(store.episodes, store.info.spec, burn_in, horizon, horizon, burn_in)
    except UserError as error:
        raise UserError(f"test store of '{store.info.source}' fits no window of the protocol: {error}") from error
    chosen = protocol_indices(windows, table.test_stride, sizes.test_windows, WINDOWS_SEED, burn_in)
    agents = [int(store.episodes[e].valid[t].sum()) for e, t in windows.index[chosen].tolist()]
    tallies, began = _Tallies(made, table, line, windows.index[chosen, 0]), time.perf_counter()
    if made.device.startswith("cuda"):
        torch.cuda.reset_peak_memory_stats()
    for outcome in run_windows(
        made.forecaster, windows, chosen, horizon, NUM_SAMPLES, seed,
        batch_size(max(agents, default=1), NUM_SAMPLES), made.device, whole_sequence=True, keep_beliefs=True,
    ):  # fmt: skip
        tallies.add(outcome)
    return {
        "windows": len(chosen),
        "agents": {"min": min(agents), "median": float(np.median(agents)), "max": max(agents)},
        **tallies.results(),
        "seconds": time.perf_counter() - began,
        "peak_memory_mb": _peak_memory_mb(made.device),
    }


class _Tallies:
    """Collects everything that is measured on one store."""

    def __init__(self, made: LineForecaster, table: PaperTable, line: Line, episodes: np.ndarray) -> None:
        self._made, self._line, self._horizon = made, line, table.protocol.horizon_steps
        threshold_m = table.overlap_m or MISS_THRESHOLD_M
        self._horizon_only = Tally(made.std_m, threshold_m)
        self._whole = Tally(miss_threshold_m=threshold_m, partial_agents=True)
        self._density = Tally()
        self._has_density = isinstance(made.forecaster, GaussianResidual | NoisyConstantVelocity)
        self._types = max(made.forecaster.num_edge_types, table.num_label_types)
        self._matched = bool(table.num_label_types) and not line.train.get("type_label_weight")
        self._graph, self._features = GraphTally(self._types), _Features(episodes)
        self._entropies: list[torch.Tensor] = []
        own = not line.residual_of  # the graph of another line is scored there
        self._scores_graph, self._scores_features = own and line.model in GRAPHS, own and line.model in FEATURED
        self._has_prior = own and line.model in ("dgvae", "dnri")

    def add(self, outcome: Outcome) -> None:
        free = outcome.tail(self._horizon)
        self._whole.add(outcome)
        self._horizon_only.add(free)
        if self._has_density:  # of draws around the single forecast, which is Gaussian
            scale = self._made.forecaster.std_m(self._horizon).to(free.forecast)
            single = free.single()
            self._density.add(replace(single, scale=scale.expand_as(single.forecast)))
        assert outcome.edge_probs is not None and outcome.present is not None
        pairs = pair_mask(outcome.present)
        unused = outcome.edge_probs.new_zeros(
            *outcome.edge_probs.shape[:-1], self._types - outcome.edge_probs.shape[-1]
        )
        self._graph.add(torch.cat([outcome.edge_probs, unused], dim=-1), _known_types(outcome, self._types), pairs)
        self._entropies.append(edge_entropy(outcome.edge_probs, pairs)[0][pairs].cpu())
        if self._scores_features:
            self._features.add(outcome)

    def results(self) -> dict[str, Any]:
        """Returns the measurements."""
        horizon_only = asdict(self._horizon_only.accuracy(self._line.name))
        if self._has_density:
            density = asdict(self._density.accuracy(self._line.name))
            for figure in ("mixture_nll", "mixture_coverage"):
                horizon_only[figure] = density[figure]
                for part in ("statistics", "step_errors"):
                    horizon_only[part][figure] = density[part][figure]
        return {
            "horizon_only": horizon_only,
            "whole_sequence": asdict(self._whole.accuracy(self._line.name)),
            "graph": asdict(self._graph.results(self._matched)) if self._scores_graph else None,
            "prior_entropy": float(torch.cat(self._entropies).mean()) if self._has_prior else None,
            "features": self._features.scores(),
        }


def _peak_memory_mb(device: str) -> float:
    """Returns the peak memory [MB] of the accelerator since measuring began, or of this process since it started."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _known_types(outcome: Outcome, num_types: int) -> torch.Tensor | None:
    """Returns the true types, limited to those that the model has."""
    return None if outcome.edge_types is None else outcome.edge_types.clamp(-1, num_types - 1)


class _Features:
    """Collects edge features and true attributes over all windows, padded to the largest scene."""

    def __init__(self, episodes: np.ndarray) -> None:
        self._episodes = episodes
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
        widest = max(valid.shape[-1] for valid in self._valid)
        features, truth, valid = (
            np.concatenate([_padded(part, widest) for part in parts])
            for parts in (self._features, self._truth, self._valid)
        )
        return {
            "direct_r2": direct_r2(features[..., 0], truth, valid),
            "linear_r2": linear_r2(features, truth, valid, groups=self._episodes),
        }


def _padded(pairs: np.ndarray, agents: int) -> np.ndarray:
    """Returns an array [windows, agents, agents, …] with room for `agents` agents."""
    missing = agents - pairs.shape[1]
    return np.pad(pairs, ((0, 0), (0, missing), (0, missing), *((0, 0),) * (pairs.ndim - 3)))
