"""Noise for samples of a batch of scenes in which each scene draws from a generator of its own.

What a scene draws depends on its own generator, on its own present pairs and on the number of samples; other scenes of
the batch, their order and padding change nothing. All numbers of a roll-out are drawn at once, scene by scene: a
generator that is listed for two scenes of a batch draws for the first one before it draws for the second.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from predictor.support.errors import UserError

Noise = torch.Generator | Sequence[np.random.Generator]
"""Source of the samples' noise: one generator for a whole batch, or one for each of its scenes."""


def check_noise(noise: object) -> None:
    """Raises a `UserError` if something is no source of noise."""
    if noise is None or isinstance(noise, torch.Generator):
        return
    wrong: list[type] = []
    if isinstance(noise, str | bytes) or not isinstance(noise, Sequence):
        wrong = [type(noise)]
    elif isinstance(noise, list | tuple):  # a sequence of another kind may make its generators when they are asked for
        wrong = [kind for kind in set(map(type, noise)) if not issubclass(kind, np.random.Generator)]
    if wrong:
        raise UserError(
            "generator must be one torch.Generator, or a list of numpy.random.Generator, one for each scene, got "
            f"{wrong[0].__name__}"
        )


class PairNoise:
    """Uniform numbers in [0, 1) for the present pairs of each scene, sample and step of one roll-out.

    Args:
        generators: one per scene; a generator may be listed more than once.
        present: which slots hold a pair.
        draws: number of samples per scene.
        steps: number of draws in the roll-out.
        types: number of values per pair.

    Raises:
        UserError: the number of generators is not the number of scenes.
    """

    def __init__(
        self,
        generators: Sequence[np.random.Generator],
        present: Bool[Tensor, "scenes agents slots"],
        draws: int,
        steps: int,
        types: int,
    ) -> None:
        """Draws the numbers for all steps, listed by scene, sample, receiver and slot."""
        if len(generators) != len(present):
            raise UserError(
                f"samples need one generator per scene, got {len(generators)} generators for {len(present)} scenes"
            )
        pairs = (draws * present.flatten(1).sum(1)).tolist()
        drawn = [np.empty((steps, 0, types), dtype=np.float32)] + [
            generator.random((steps, count, types), dtype=np.float32)
            for generator, count in zip(generators, pairs, strict=True)
        ]
        self._steps = iter(torch.from_numpy(np.concatenate(drawn, axis=1)).to(present.device))
        self._present = present.repeat_interleave(draws, dim=0)

    def like(self, logits: Float[Tensor, "*batch types"]) -> Float[Tensor, "*batch types"]:
        """Returns the next step's numbers: for listed present pairs, or for an array with a place for every pair."""
        listed = next(self._steps).to(logits.dtype)
        if logits.ndim == 2:
            return listed
        placed = torch.full_like(logits, 0.5)
        placed[self._present] = listed
        return placed


class RepeatedNoise:
    """Uniform numbers that every plan of a scene shares: those that the scene would get without plans.

    Args:
        noise: source of the numbers.
        unrepeated: function from the logits of all plans to as many as without plans, of which only the shape is read.
        repeat: function that repeats numbers for each plan, in the order of the logits.
    """

    def __init__(
        self,
        noise: "torch.Generator | PairNoise | None",
        unrepeated: Callable[[Tensor], Tensor],
        repeat: Callable[[Tensor], Tensor],
    ) -> None:
        """Stores source and functions; draws nothing."""
        self._noise, self._unrepeated, self._repeat = noise, unrepeated, repeat

    def like(self, logits: Float[Tensor, "*batch types"]) -> Float[Tensor, "*batch types"]:
        """Returns the next step's numbers."""
        return self._repeat(uniform_like(self._unrepeated(logits), self._noise))


class NoiseOfRows:
    """Uniform numbers for some rows of a batch: those that they get where one generator draws for the whole batch.

    Args:
        generator: source of the numbers, at the same place in every process that draws for the batch.
        rows: rows of the batch.
        total: number of rows of the whole batch.
    """

    def __init__(self, generator: torch.Generator, rows: slice, total: int) -> None:
        """Stores the arguments; draws nothing."""
        self._generator, self._rows, self._total = generator, rows, total

    def like(self, logits: Float[Tensor, "rows *pairs types"]) -> Float[Tensor, "rows *pairs types"]:
        """Returns the next numbers of the rows."""
        shape = (self._total, *logits.shape[1:])
        return torch.rand(shape, generator=self._generator, device=logits.device, dtype=logits.dtype)[self._rows]


TrainingNoise = torch.Generator | NoiseOfRows
"""Source of the noise of a training step."""
NoiseOfPairs = TrainingNoise | PairNoise | RepeatedNoise
"""Source of the noise of one roll-out."""


def uniform_like(logits: Float[Tensor, "*batch types"], noise: NoiseOfPairs | None) -> Float[Tensor, "*batch types"]:
    """Draws uniform numbers in [0, 1), one for each logit."""
    if isinstance(noise, PairNoise | RepeatedNoise | NoiseOfRows):
        return noise.like(logits)
    return torch.rand(logits.shape, generator=noise, device=logits.device, dtype=logits.dtype)


def repeat_scenes(times: int) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
    """Returns functions that undo and do the repetition of each scene of a batch, for `RepeatedNoise`."""
    return lambda pairs: pairs[::times], lambda pairs: pairs.repeat_interleave(times, dim=0)


def noise_of_pairs(
    noise: Noise | None, present: Bool[Tensor, "scenes agents slots"], draws: int, steps: int, types: int
) -> torch.Generator | PairNoise | None:
    """Returns what `concrete_sample` draws from during one roll-out; see `PairNoise` for the arguments."""
    if noise is None or isinstance(noise, torch.Generator):
        return noise
    return PairNoise(noise, present, draws, steps, types)


def uniform_of_agents(
    noise: Noise | None, valid: Bool[Tensor, "scenes agents"], draws: int
) -> Float[Tensor, "scenes draws agents"]:
    """Draws uniform numbers in [0, 1) for each agent; with one generator per scene, only for present agents.

    Raises:
        UserError: the number of generators is not the number of scenes.
    """
    shape = (len(valid), draws, valid.shape[1])
    if noise is None or isinstance(noise, torch.Generator):
        return torch.rand(shape, device=valid.device, generator=noise)
    return _of_present(noise, valid, shape, lambda own, size: own.random(size, dtype=np.float32))


def normal_of_agents(
    noise: Noise | None, valid: Bool[Tensor, "scenes agents"], draws: int, numbers: int
) -> Float[Tensor, "scenes draws agents numbers"]:
    """Draws standard normal numbers for each agent; with one generator per scene, only for present agents.

    Raises:
        UserError: the number of generators is not the number of scenes.
    """
    shape = (len(valid), draws, valid.shape[1], numbers)
    if noise is None or isinstance(noise, torch.Generator):
        return torch.randn(shape, device=valid.device, generator=noise)
    return _of_present(noise, valid, shape, lambda own, size: own.standard_normal(size, dtype=np.float32))


def _of_present(
    noise: Sequence[np.random.Generator],
    valid: Tensor,
    shape: tuple[int, ...],
    draw: Callable[[np.random.Generator, tuple[int, ...]], np.ndarray],
) -> Tensor:
    if len(noise) != len(valid):
        raise UserError(f"samples need one generator per scene, got {len(noise)} generators for {len(valid)} scenes")
    drawn = torch.zeros(shape)
    for scene, (own, present) in enumerate(zip(noise, valid.cpu(), strict=True)):
        numbers = draw(own, (shape[1], int(present.sum()), *shape[3:]))
        drawn[scene, :, present] = torch.from_numpy(numbers)
    return drawn.to(valid.device)
