"""Files that earlier versions wrote are read, and mean what they meant."""

import json
from pathlib import Path

import numpy as np
import pytest

from predictor.data.store import read_store
from tests.golden.make import HERE, MODELS, forecasts, golden_episode

VERSIONS = sorted(path.name for path in HERE.iterdir() if (path / "store").is_dir())


def test_there_are_golden_files():
    assert "0.1.0" in VERSIONS


@pytest.mark.parametrize("version", VERSIONS)
def test_a_store_holds_the_episodes_that_were_written(version: str):
    store = read_store(HERE / version / "store")
    assert (store.info.source, store.info.edge_attribute_names) == ("golden", ("gap_m",))
    assert store.info.causal_threshold_m == 0.5 and store.info.provenance == {"seed": 0}
    for seed, found in enumerate(store.episodes):
        expected = golden_episode(seed)
        assert (found.seed, found.label) == (seed, expected.label)
        for name in ("states", "valid", "ids", "edge_types", "edge_attributes", "causal_shift_m", "perturbed"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("version", VERSIONS)
def test_a_checkpoint_forecasts_what_it_forecast(version: str, name: str):
    """To rounding, which differs between processors."""
    folder = Path(HERE / version)
    expected = json.loads((folder / "forecasts.json").read_text())[name]
    found = np.array(forecasts(folder, name))
    assert found.shape == np.shape(expected) and np.abs(found).max() > 1.0
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)
