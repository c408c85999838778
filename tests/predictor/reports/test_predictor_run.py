"""The page of a predictor's run, from a training that was just made."""

from pathlib import Path

import pytest

from predictor.reports.document import PNG, Picture, as_html
from predictor.reports.predictor_run import predictor_blocks
from predictor.support.errors import UserError
from predictor.support.files import write_json
from predictor.support.reading import read_object
from predictor.train import train
from predictor.training.config import TrainConfig
from predictor.training.curve import CURVE_FILE, add_point, read_curve
from tests.predictor.helpers import write_circles

POINT = {
    "step": 4, "energy_m": 1.0, "ade_m": 2.0, "fde_m": 3.0, "min_ade_m": 1.5, "min_joint_ade_m": 1.7,
    "constant_velocity_ade_m": 4.0,
}  # fmt: skip


@pytest.mark.slow
def test_the_page_has_curves_of_every_validation(tmp_path: Path):
    write_circles(tmp_path / "data")
    sizes = ("hidden_dim=4", "rnn_dim=3", "head_dim=4", "message_dim=4", "decoder_dim=4", "num_modes=2")
    run = tmp_path / "run"
    train(TrainConfig(
        (tmp_path / "data",), run, set=sizes, steps=4, batch_size=2, history_steps=3, horizon_steps=2, val_windows=4,
        eval_every=2,
    ))  # fmt: skip
    curve = read_curve(run / CURVE_FILE)
    assert [point["step"] for point in curve] == [2, 4]
    (run / "checkpoint" / "README.md").write_text("# A <card>")
    blocks = predictor_blocks(run, [])
    page = as_html("x", blocks)
    for shown in (
        "dG-VAE, trained on",
        "<h2>Validation</h2>",
        "the checkpoint is the one with the lowest energy score.",
        "&lt;card&gt;",
        "<td>steps</td><td>4</td>",
        "commit",
    ):
        assert shown in page, shown
    (picture,) = (block for block in blocks if isinstance(block, Picture))
    assert picture.png.startswith(PNG) and "constant velocity" in picture.svg and "training steps" in picture.svg
    changed = read_object(run / "config.json")
    changed["config"]["keep"] = "last"
    write_json(run / "config.json", changed)
    assert "the checkpoint is the last one." in as_html("x", predictor_blocks(run, []))
    (run / CURVE_FILE).unlink()
    assert "No curve.json: the run is older" in as_html("x", predictor_blocks(run, []))
    (run / "checkpoint").rename(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="has no checkpoint yet: its training has not validated"):
        predictor_blocks(run, [])


def test_a_training_that_goes_on_from_before_forgets_later_points(tmp_path: Path):
    path = tmp_path / CURVE_FILE
    for step in (4, 8, 12, 8):
        add_point(path, POINT | {"step": step, "ade_m": float("nan")})
    assert [point["step"] for point in read_curve(path)] == [4, 8]


@pytest.mark.parametrize("content", [3, [3], [{"step": 1}], [POINT | {"ade_m": "x"}]])
def test_a_damaged_curve_is_one_sentence(tmp_path: Path, content: object):
    write_json(tmp_path / CURVE_FILE, content)
    with pytest.raises(UserError, match="is damaged; remove it to go on without it"):
        read_curve(tmp_path / CURVE_FILE)
