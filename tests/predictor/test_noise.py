import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.noise import PairNoise, noise_of_pairs
from predictor.support.errors import UserError

PRESENT = torch.tensor([[[0, 1], [1, 0]], [[0, 0], [0, 0]], [[0, 1], [0, 0]]], dtype=torch.bool)
DRAWS, STEPS, TYPES = 2, 3, 2


def generators(*seeds: int) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in seeds]


def listed(noise: PairNoise, pairs: int) -> Tensor:
    return torch.stack([noise.like(torch.zeros(pairs, TYPES)) for _ in range(STEPS)])


def test_each_scene_draws_its_present_pairs_from_its_own_generator():
    together = listed(PairNoise(generators(5, 6, 7), PRESENT, DRAWS, STEPS, TYPES), 6)
    first = listed(PairNoise(generators(5), PRESENT[:1], DRAWS, STEPS, TYPES), 4)
    last = listed(PairNoise(generators(7), PRESENT[2:], DRAWS, STEPS, TYPES), 2)
    assert torch.equal(together, torch.cat([first, last], dim=1))
    assert together.unique().numel() == together.numel()
    assert 0 <= together.min() and together.max() < 1


def test_an_array_of_pairs_gets_what_a_list_of_pairs_gets():
    noise = PairNoise(generators(5, 6, 7), PRESENT, DRAWS, STEPS, TYPES)
    expected = listed(PairNoise(generators(5, 6, 7), PRESENT, DRAWS, STEPS, TYPES), 6)
    there = PRESENT.repeat_interleave(DRAWS, dim=0)
    for step in range(STEPS):
        placed = noise.like(torch.zeros(6, 2, 2, TYPES, dtype=torch.float64))
        assert placed.dtype is torch.float64
        assert torch.equal(placed[there].float(), expected[step])


def test_a_scene_listed_twice_draws_all_steps_of_the_first_before_the_second():
    generator, alone = np.random.default_rng(5), np.random.default_rng(5)
    twice = PRESENT[:1].repeat(2, 1, 1)
    both = listed(PairNoise([generator, generator], twice, DRAWS, STEPS, TYPES), 8)
    first = listed(PairNoise([alone], PRESENT[:1], DRAWS, STEPS, TYPES), 4)
    second = listed(PairNoise([alone], PRESENT[:1], DRAWS, STEPS, TYPES), 4)
    assert torch.equal(both, torch.cat([first, second], dim=1))


def test_one_generator_for_all_scenes_is_passed_on():
    generator = torch.Generator()
    assert noise_of_pairs(generator, PRESENT, DRAWS, STEPS, TYPES) is generator
    assert noise_of_pairs(None, PRESENT, DRAWS, STEPS, TYPES) is None


def test_too_few_generators_are_named():
    with pytest.raises(UserError, match="one generator per scene, got 2 generators for 3 scenes"):
        PairNoise(generators(1, 2), PRESENT, DRAWS, STEPS, TYPES)
