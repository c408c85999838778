"""The annotations of shapes and types execute in every test of this suite; these tests fail if they stop doing so."""

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from predictor.evaluation.displacement import min_ade
from predictor.graph import pair_mask
from predictor.scene import Scene
from tests.predictor.helpers import model, random_presence, random_states

pytestmark = pytest.mark.shapes


def test_swapped_axes_raise():
    forecast, future, valid = torch.zeros(2, 3, 4, 5, 2), torch.zeros(2, 4, 5, 2), torch.ones(2, 4, 5).bool()
    min_ade(forecast, future, valid)
    with pytest.raises(TypeCheckError, match="min_ade"):
        min_ade(forecast.transpose(1, 2), future, valid)


def test_swapped_axes_raise_inside_the_model():
    forecaster = model()
    states, valid = random_states(0, 2, 3, 4), random_presence(0, 2, 3)
    forecaster.observe(forecaster.empty_memory(2, 3), states, valid)
    with pytest.raises(TypeCheckError, match="valid"):
        forecaster.observe(forecaster.empty_memory(2, 3), states, valid.T)


def test_wrong_dtype_raises():
    with pytest.raises(TypeCheckError, match="pair_mask"):
        pair_mask(torch.ones(3))


def test_fields_of_a_scene_agree_on_the_number_of_agents():
    with pytest.raises(TypeCheckError, match="ids"):
        Scene(np.zeros((3, 4)), np.arange(2), np.ones(3, dtype=np.bool_))
