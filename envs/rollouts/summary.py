"""Summarises the episodes of one environment: the accuracy of the deployed forecasts, of controls and of ablations."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from envs.rollouts.episode import EDGES, MODEL, NEIGHBOURS, NOISY, RESIDUAL, STRAIGHT, Episode, memory_key
from envs.rollouts.report import BEFORE_CRASH_S, EnvAccuracy
from predictor.checkpoint import CONSTANT_VELOCITY, name_of_folder, read_info
from predictor.evaluation.accuracy import Accuracy, Tally, fitted_std_m
from predictor.evaluation.displacement import min_ade, miss_distance_m
from predictor.evaluation.graph_accuracy import GraphAccuracy, GraphTally
from predictor.evaluation.outcomes import Outcome
from predictor.evaluation.standard_errors import Estimate, estimate, quotient
from predictor.graph import pair_mask
from predictor.own_forecasters import is_own
from predictor.reports.tables import MODEL_NAMES
from predictor.scene import SceneSpec

CONTROLS = (RESIDUAL, NEIGHBOURS, NOISY)
"""Keys of the controls, in the order of the table's lines."""


def summarise_episodes(
    env_id: str,
    checkpoint: str,
    driver: str,
    spec: SceneSpec,
    episodes: Sequence[Episode],
    histories: Sequence[int] = (),
    miss_m: float | None = None,
    shown_as: str | None = None,
    env_kwargs: str = "",
) -> EnvAccuracy:
    """Returns the accuracy of one checkpoint in one environment.

    Args:
        env_id: id of the environment.
        checkpoint: folder of the checkpoint, or "constant-velocity".
        driver: name of the driver.
        spec: layout of the scenes.
        episodes: episodes that were played.
        histories: numbers of steps to which the memory was limited in ablations.
        miss_m: final displacement above which a forecast misses [m]; None takes 2 m on roads, a tenth of a small
            arena's scale.
        shown_as: name of the checkpoint in tables; None takes its folder's.
        env_kwargs: arguments of the environment, as the text of a JSON object.
    """
    miss_m = miss_m or miss_distance_m(spec.feature_scales[0])
    outcomes = {key: [e.outcomes[key] for e in episodes] for key in episodes[0].outcomes}
    first = [outcome.single() for outcome in outcomes[MODEL]]
    learned = checkpoint != CONSTANT_VELOCITY
    std_m, name = _spread_and_name(checkpoint, first)

    def line(title: str, found: Sequence[Outcome], spread: Sequence[float], partial: bool = False) -> Accuracy:
        tally = Tally(spread, miss_m, partial)
        for number, outcome in enumerate(found):
            tally.add(replace(outcome, episode=np.full(len(outcome.future), number)))
        return tally.accuracy(title, batch_intervals=True)

    # The spread of the baselines is fitted on these very errors, in their favour: they have no validation data.
    straight = line("constant velocity", outcomes[STRAIGHT], fitted_std_m(outcomes[STRAIGHT]))
    reduction = _reduction(first, outcomes[STRAIGHT])
    pairs = [first, outcomes[STRAIGHT]]
    last = max(1, round(BEFORE_CRASH_S / spec.dt_s))  # the scene of the crash is none: no forecast follows it
    crashes = [[o.last_windows(last) for o, e in zip(p, episodes, strict=True) if e.crashed] for p in pairs]
    to_the_end, before_crash = (
        (line(name, own, (), partial=True), line("constant velocity", straight_ahead, (), partial=True))
        if any(bool(o.valid.any()) for o in own)
        else None
        for own, straight_ahead in (pairs, crashes)
    )
    latencies_ms = 1e3 * np.concatenate([e.latencies_s[1:] or e.latencies_s for e in episodes])  # the first warms up
    return EnvAccuracy(
        env_id,
        shown_as or name_of_folder(checkpoint),
        driver,
        spec.dt_s,
        line(name, first, std_m),
        line(name, outcomes[MODEL], std_m),
        straight,
        None if reduction is None else reduction.value,
        None if reduction is None else reduction.interval,
        {key: line(key, outcomes[key], fitted_std_m(outcomes[key])) for key in CONTROLS if key in outcomes},
        {n: line(f"{name}, {n} step{'s' * (n > 1)} of history", outcomes[memory_key(n)], std_m) for n in histories},
        _graph(episodes) if learned else None,
        float(np.median(latencies_ms)),
        float(np.percentile(latencies_ms, 95)),
        {key: line(f"{name}, {key}", outcomes[key], std_m) for key in EDGES if key in outcomes},
        to_the_end,
        before_crash,
        env_kwargs,
    )


def _spread_and_name(checkpoint: str, forecasts: Sequence[Outcome]) -> tuple[Sequence[float], str]:
    """Returns the spread of the model's errors [m], fitted here where a checkpoint does not say it, and its name."""
    if is_own(checkpoint):
        return fitted_std_m(forecasts), name_of_folder(checkpoint)
    if checkpoint == CONSTANT_VELOCITY:
        return fitted_std_m(forecasts), "constant velocity (deployed)"
    info = read_info(Path(checkpoint))
    return info.std_m, MODEL_NAMES.get(info.model, "model")


def _graph(episodes: Sequence[Episode]) -> GraphAccuracy | None:
    """Returns the accuracy of inferred against true edges over all scenes; None where simulator or model has none."""
    labelled = [episode for episode in episodes if episode.edge_types]
    num_types = labelled[0].edge_probs[0].shape[-1] if labelled else 0
    if num_types < 2:
        return None
    tally = GraphTally(num_types)
    for episode in labelled:
        types = torch.from_numpy(np.stack(episode.edge_types))
        known = pair_mask((types != -1).any(-1) | (types != -1).any(-2)) & (types != -1)
        tally.add(torch.from_numpy(np.stack(episode.edge_probs)), types, known)
    return tally.results()


def _reduction(model: Sequence[Outcome], baseline: Sequence[Outcome]) -> Estimate | None:
    """Returns the relative reduction of ADE, by a bootstrap over paired episodes; None without an error to reduce."""
    sums = np.zeros((len(model), 2))
    for i, outcomes in enumerate(zip(model, baseline, strict=True)):
        for j, outcome in enumerate(outcomes):
            error, _ = min_ade(outcome.forecast, outcome.future, outcome.valid)
            sums[i, j] = float(error[outcome.valid.all(-1)].sum())
    return estimate(sums, lambda totals: 1 - quotient(totals[:, 0], totals[:, 1]))
