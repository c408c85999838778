"""Draws and scores the edges of a dG-VAE: `python -m predictor.interpret --checkpoint DIR --data STORE`.

Runs a trained model on windows and writes `graph.png` (inferred graph beside the truth), `features.png` (edge
features as matrices), `trajectories.png` (samples beside the truth), `scores.json` and `scores.md`: the correlation of
feature dimensions with known properties of edges, beside chance and the distance between agents; disentanglement of the
features (DCI, MIG); their change over time. Stores without labels get the parts that need none.

Features are those of the last observed step, from the past alone. A correlation shows that a feature contains the
property, not that the decoder uses it (docs/interpretability.md).
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from rich.console import Console
from rich.markdown import Markdown

from predictor.checkpoint import CONSTANT_VELOCITY, CheckpointInfo, load_checkpoint, name_of_folder
from predictor.data.store import StoreInfo, read_store
from predictor.data.windows import Windows
from predictor.evaluation.disentanglement import sklearn
from predictor.evaluation.edge_findings import Findings, infer_edges, measure
from predictor.evaluation.outcomes import run_window_batch
from predictor.reports import edge_plots as pictures
from predictor.reports.tables import scores_markdown
from predictor.scene import SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out, finite, scratch_folder, write_json, write_text
from predictor.support.memory import check_count
from predictor.support.progress import track
from predictor.support.provenance import provenance
from predictor.support.runtime import resolve_device

BATCH_BYTES = 64_000_000
"""Largest size of the edge features of a batch over time [bytes]."""
FEATURED = ("dgvae",)
"""Models with edge features; the others return zeros."""
FILES = ("graph.png", "features.png", "trajectories.png", "scores.json", "scores.md")


@dataclass(frozen=True)
class InterpretConfig:
    """Draws and scores the edges and edge features of a checkpoint."""

    checkpoint: str
    """Checkpoint of a dG-VAE: shipped name, folder or run folder."""
    data: Path
    """Episode store that was not trained on; edge labels are used where it has them."""
    out: Path
    """Folder for the three pictures, scores.json and scores.md."""
    max_windows: int = 300
    """Number of windows measured at most, drawn evenly from the store."""
    burn_in_steps: int = 40
    """Number of steps observed in every window before features are read and the forecast begins."""
    horizon_steps: int = 10
    """Number of steps forecast in trajectories.png; a window has so many after its burn-in."""
    num_samples: int = 20
    """Number of forecasts drawn for each agent."""
    seed: int = 0
    """Random seed for window sampling, forecasts and shuffles."""
    device: str = "cpu"
    """Device that runs the model: cpu, cuda or auto (cuda where there is one)."""

    def __post_init__(self) -> None:
        """Checks ranges; `device="auto"` becomes the device that is taken.

        Raises:
            UserError: a value out of range, or a device that is not there.
        """
        check_at_least(self, 1, "max_windows", "burn_in_steps", "horizon_steps", "num_samples")
        check_at_least(self, 0, "seed")
        check_count(self.num_samples, "num_samples")
        check_count(self.num_samples * self.horizon_steps, "horizon_steps times num_samples")
        object.__setattr__(self, "device", resolve_device(self.device))


def interpret(config: InterpretConfig) -> Findings:
    """Measures, draws and writes all files below `config.out`; writes nothing after an error.

    Raises:
        UserError: `out` is a file, the model has no edge features, the store does not fit it, or no window is long
            enough.
    """
    check_out(config.out)
    model, info = _load_model(config.checkpoint, config.device)
    store = read_store(config.data)
    info.spec.check_recorded(store.info.spec, f"checkpoint '{config.checkpoint}'", f"store {config.data}")
    if any(e.edge_types is not None or e.edge_attributes is not None for e in store.episodes):
        sklearn("metrics")  # raises before measuring, not after it
    try:
        lengths = (config.burn_in_steps, config.horizon_steps)
        windows = Windows(
            store.episodes, info.spec, *lengths, min_future_steps=lengths[1], min_history_steps=lengths[0]
        )
    except UserError as error:
        raise UserError(f"store {config.data}: {error}; lower --burn-in-steps or --horizon-steps") from error
    drawn = np.random.default_rng(config.seed).permutation(len(windows))[: config.max_windows]
    first = _with_pairs(windows, drawn)
    if not first:
        raise UserError(
            f"store {config.data}: none of {len(drawn)} windows has two agents at once, so there are no edges"
        )
    columns = max(e.states.shape[1] for e in store.episodes)
    size = max(1, BATCH_BYTES // (4 * config.burn_in_steps * columns**2 * model.edge_feature_dim))
    parts = np.array_split(np.sort(drawn), -(-len(drawn) // size))
    findings, accuracies = measure(
        model,
        windows,
        track(parts, "infer edges"),
        store.info.edge_attribute_names,
        config.seed,
        config.device,
    )
    content = _content(config, info, store.info, findings)
    out = config.out.resolve()
    with scratch_folder(out) as partial:
        shown = _shown(config, model, windows, first, store.info)
        graphs = _shown(config, model, windows, _by_accuracy(np.sort(drawn), accuracies), store.info)
        _draw(partial, config, content, findings, shown, graphs, info.spec)
        write_json(partial / "scores.json", finite(content))
        write_text(partial / "scores.md", scores_markdown(content))
        out.mkdir(exist_ok=True)
        for name in FILES:
            if (partial / name).exists():
                os.replace(partial / name, out / name)
            else:  # of an earlier run, which does not belong to the new files
                (out / name).unlink(missing_ok=True)
    return findings


def _load_model(name: str, device: str) -> tuple[Any, CheckpointInfo]:
    if name == CONSTANT_VELOCITY:
        raise UserError("'constant-velocity' has no edge features to interpret; pass a dG-VAE checkpoint")
    model, info = load_checkpoint(name, device)
    if info.model not in FEATURED or not model.edge_feature_dim:
        what = "was trained with edge_feature_dim=0" if info.model in FEATURED else f"is a model '{info.model}'"
        raise UserError(
            f"checkpoint '{name}' {what} and has no edge features to interpret; pass a dG-VAE with edge_feature_dim > 0"
        )
    return model, info


def _with_pairs(windows: Windows, drawn: Int[np.ndarray, " drawn"]) -> list[int]:
    """Returns the first `NUM_TRAJECTORIES` drawn windows with a pair at the last observed step."""
    found: list[int] = []
    for index in drawn.tolist():
        batch = windows.batch(np.array([index]))
        if int(batch.valid[0, int(batch.last_observed[0])].sum()) > 1:
            found.append(index)
        if len(found) == pictures.NUM_TRAJECTORIES:
            break
    return found


def _by_accuracy(indices: Int[np.ndarray, " windows"], accuracies: Float[np.ndarray, " known"]) -> list[int]:
    """Returns the windows at the drawn quantiles of graph accuracy; none without a known truth."""
    if not len(accuracies):
        return []
    order = indices[np.argsort(accuracies, kind="stable")][: int((~np.isnan(accuracies)).sum())]  # NaN is last
    return [int(order[int(round(q * (len(order) - 1)))]) for q in pictures.GRAPH_QUANTILES] if len(order) else []


def _content(config: InterpretConfig, info: CheckpointInfo, store: StoreInfo, findings: Findings) -> dict[str, Any]:
    """Returns the content of scores.json, from which scores.md is written."""
    return {
        "source": store.source,
        "dt_s": info.spec.dt_s,
        "has_ego": info.spec.has_ego,
        "static_dim": info.config.static_dim,
        "config": asdict(config),
        **asdict(findings),
        "provenance": provenance(("torch", "numpy", "scikit-learn")),
    }


def _shown(
    config: InterpretConfig, model: Any, windows: Windows, indices: Iterable[int], store: StoreInfo
) -> list[pictures.WindowShown]:
    """Returns windows with the arrays of all pictures."""
    device, made = torch.device(config.device), []
    for index in indices:
        batch = windows.batch(np.array([index]))
        inferred = infer_edges(model, batch.to(device))
        generator = torch.Generator(device).manual_seed(config.seed)
        outcome = run_window_batch(model, batch.to(device), config.horizon_steps, config.num_samples, generator)
        episode, last = windows.index[index].tolist()
        now = int(batch.last_observed[0])
        made.append(
            pictures.WindowShown(
                f"episode {episode}, step {last}",
                _agent_names(batch.states.shape[2], store),
                batch.states[0, : now + 1, :, : windows.spec.position_dim].numpy(),
                batch.valid[0, : now + 1].numpy(),
                inferred.features[0],
                1 - inferred.edge_probs[0, -1, ..., 0],
                inferred.pairs[0],
                outcome.forecast[0].cpu().numpy(),
                outcome.future[0].cpu().numpy(),
                outcome.valid[0].cpu().numpy(),
                None if batch.edge_types is None else batch.edge_types[0, now].numpy(),
                None if batch.edge_attributes is None else batch.edge_attributes[0, now].numpy(),
            )
        )
    return made


def _agent_names(agents: int, store: StoreInfo) -> list[str]:
    """Returns the joint names if the store has them and all joints are present, else numbers."""
    joints = store.provenance.get("joints", ())
    if isinstance(joints, list) and len(joints) == agents:
        return [str(joint) for joint in joints]
    return ["ego" if store.spec.has_ego and not i else str(i) for i in range(agents)]


def _draw(
    folder: Path,
    config: InterpretConfig,
    content: dict[str, Any],
    findings: Findings,
    shown: Sequence[pictures.WindowShown],
    graphs: Sequence[pictures.WindowShown],
    spec: SceneSpec,
) -> None:
    """Draws and writes the pictures."""
    where = f"{name_of_folder(config.checkpoint)} on {content['source']}"
    names = [score.name for score in findings.attributes]
    figures = {
        "features.png": pictures.features_figure(shown[0], content["static_dim"], spec.dt_s, names, where),
        "trajectories.png": pictures.trajectories_figure(shown, spec.feature_names, where),
    }
    if graphs and findings.graph is not None:
        figures["graph.png"] = pictures.graphs_figure(
            graphs, findings.reading, names, findings.graph, where, on_circle=not spec.has_ego
        )
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=110)


def main() -> None:
    """Entry point."""
    config = parse(InterpretConfig, __doc__)
    interpret(config)
    Console(width=160).print(Markdown((config.out / "scores.md").read_text(encoding="utf-8")))


if __name__ == "__main__":
    run_entry_point(main)
