"""A training step can be recorded as a CUDA graph: it never looks at a result, and never sends anything to the device.

Without a GPU this is seen on the "meta" device, whose tensors have shapes and no content: whoever reads one, or makes
a shape of one, fails there as capturing fails on CUDA. What meta tensors would not notice (constants copied from the
host, which CUDA waits for) two modes look out for. Fake CUDA tensors would serve as well, but a build of torch without
CUDA cannot differentiate or index them.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

from predictor.data.device_windows import ResidentWindows
from predictor.data.store import Episode
from predictor.data.windows import WindowBatch, Windows
from predictor.dgvae.config import DGVAEConfig
from predictor.models import build
from predictor.training.config import TrainConfig
from predictor.training.objective import window_loss
from tests.predictor.helpers import EVERY_MODEL, RICH, random_presence, random_states, spec

META = torch.device("meta")
FROM_HOST = (torch.tensor, torch.as_tensor, torch.asarray, torch.from_numpy, Tensor.new_tensor)
CONFIG = TrainConfig((Path(),), Path(), edge_cost=1.0, label_weight=1.0, type_label_weight=1.0)
KINDS: dict[str, tuple[str, Any]] = EVERY_MODEL | {
    "dgvae-paper": ("dgvae", DGVAEConfig()),
    "dgvae-springs": (
        "dgvae",
        replace(
            DGVAEConfig(edge_feature_dim=16),
            innovation_rounds=1,
            forget_bias=2.0,
            residual="trapezoid",
            substeps=2,
            gated_messages=True,
            change_scales=(1.0, 1.0, 1.0, 1.0),
            dropout=0.1,
        ),
    ),
    "dgvae-no-features": ("dgvae", replace(RICH, edge_feature_dim=0, static_dim=0)),
}


class FromHostError(AssertionError):
    pass


class NoConstants(TorchFunctionMode):
    """Nothing is made of Python numbers, lists or arrays: on CUDA that is a copy which the host waits for.

    Every tensor says that it is on CUDA, so that what is done there alone is done here.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func == Tensor.is_cuda.__get__:
            return True
        listed = func in (Tensor.__getitem__, Tensor.__setitem__) and any(
            isinstance(i, list | np.ndarray) for i in (args[1] if isinstance(args[1], tuple) else (args[1],))
        )
        if func in FROM_HOST or listed:
            raise FromHostError(f"{func.__name__} makes a tensor of what the host knows")
        return func(*args, **(kwargs or {}))


class NoHostTensors(TorchDispatchMode):
    """No tensor of the host takes part, not even a scalar: a recording would keep the value it had once."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        for leaf in pytree.tree_leaves((args, kwargs)):
            if isinstance(leaf, Tensor) and leaf.device.type == "cpu":
                raise FromHostError(f"{func} takes a tensor of the host")
        return func(*args, **kwargs)


def meta_batch(labels: bool = True) -> WindowBatch:
    """Of shapes alone."""
    types = torch.zeros(3, 6, 4, 4, dtype=torch.int8, device=META) if labels else None
    attributes = torch.zeros(3, 6, 4, 4, 1, device=META) if labels else None
    return WindowBatch(
        torch.zeros(3, 6, 4, 4, device=META),
        torch.zeros(3, 6, 4, dtype=torch.bool, device=META),
        torch.zeros(3, dtype=torch.int64, device=META),
        types,
        attributes,
    )


def step(kind: str, rollout_steps: int = 3, labels: bool = True) -> None:
    """Forward, loss, backward and clipping, as in training."""
    name, config = KINDS[kind]
    settings = replace(CONFIG, label_weight=float(getattr(config, "edge_feature_dim", 0) > 0))
    model: Any = build(name, spec(), config, horizon_steps=3).to(META)
    batch, kl_scale, scales = meta_batch(labels), torch.ones((), device=META), torch.ones(4, device=META)
    with NoConstants(), NoHostTensors():
        output = model.window(batch.states, batch.valid, batch.last_observed, rollout_steps, None)
        loss, terms = window_loss(model, batch, output, settings, kl_scale, scales)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    assert {t.device.type for t in (loss, norm, *terms.values())} == {"meta"}
    assert all(p.grad is not None for p in model.parameters()) or not rollout_steps


@pytest.mark.slow
@pytest.mark.parametrize(("rollout_steps", "labels"), [(0, True), (3, True), (3, False)])
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_training_step_never_looks_at_a_result(kind: str, rollout_steps: int, labels: bool):
    step(kind, rollout_steps, labels)


def test_windows_on_a_device_are_cut_without_looking():
    """With an ego, labels and agents that come and go: everything that the index arithmetic has to offer."""
    presence = [random_presence(i, 9, 5).numpy() for i in range(3)]
    episodes = [
        Episode(
            random_states(i, 9, 5, 4).numpy() * there[..., None],
            there,
            np.arange(5),
            edge_types=np.zeros((1, 5, 5), dtype=np.int8),
            edge_attributes=np.zeros((1, 5, 5, 2), dtype=np.float32),
        )
        for i, there in enumerate(presence)
    ]
    resident = ResidentWindows([Windows(episodes, spec(), 4, 2)], META)
    with NoConstants(), NoHostTensors():
        batch = resident.batch(torch.zeros(7, dtype=torch.int64, device=META), history_steps=3, time=6)
    assert batch.states.shape == (7, 6, resident.agents, 4)
    assert all(getattr(batch, f.name).device == META for f in fields(batch))


# --- The guard itself -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        lambda x: float(x.sum()),
        lambda x: x.sum().item(),
        lambda x: bool((x > 0).any()),
        lambda x: x.tolist(),
        lambda x: x.cpu(),
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: torch.zeros(int(x.max())),
        lambda x: x * torch.tensor([1.0, 2.0], device=META),
        lambda x: x + x.new_tensor([1.0, 2.0]),
        lambda x: x + torch.ones(2),
        lambda x: x * torch.ones(()),
        lambda x: x + torch.ones(2).to(META),
        lambda x: x[[0, 1]],
        lambda x: x[torch.arange(2)],
    ],
    ids=["float", "item", "bool", "list", "cpu", "mask", "nonzero", "size", "tensor", "new_tensor", "mixed", "scalar",
         "moved", "index_list", "index_of_host"],
)  # fmt: skip
def test_guard_sees_what_capturing_forbids(wrong: Callable[[Tensor], Any]):
    x = torch.zeros(3, 2, device=META)
    with pytest.raises((RuntimeError, NotImplementedError, FromHostError)), NoConstants(), NoHostTensors():
        wrong(x)


def test_guard_sees_a_constant_in_the_loss():
    """The scales of the likelihood, left out, are copied from the host in every step."""
    name, config = KINDS["mlp"]
    model: Any = build(name, spec(), config, horizon_steps=3).to(META)
    batch = meta_batch()
    output = model.window(batch.states, batch.valid, batch.last_observed, 3, None)
    with pytest.raises(FromHostError, match="tensor makes a tensor"), NoConstants(), NoHostTensors():
        window_loss(model, batch, output, CONFIG)
