"""Forecasters of a user's own by name: of a module, or of an installed package."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.checkpoint import load_forecaster, name_of_folder, require_known, resolve
from predictor.forecaster import Belief, Futures
from predictor.own_forecasters import GROUP, WatchedForecaster, find_own, is_own, make_own
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

SPEC = SceneSpec(dt_s=0.5)
NAME = "own:tests.predictor.test_own_forecasters:"


class Mine(ConstantVelocity):
    """Forecaster of a user."""


ready = Mine(SPEC)
nothing = None


def noisy(spec: SceneSpec) -> NoisyConstantVelocity:
    return NoisyConstantVelocity(spec, 1.0, 1.0)


def coarse(spec: SceneSpec) -> Mine:
    return Mine(replace(spec, dt_s=2.0))


def fails(spec: SceneSpec) -> Any:
    raise KeyError("weights")


def number(spec: SceneSpec) -> Any:
    return 3


class Raises(Mine):
    def rollout(self, *_: Any, **__: Any) -> Any:
        raise KeyError("weights")


class Silent(Mine):
    def observe(self, *_: Any) -> Any:
        raise UserError("no map of this road; give one")


class Short(Mine):
    def rollout(self, belief: Belief, horizon_steps: int, *rest: Any) -> Futures:
        return super().rollout(belief, horizon_steps - 1, *rest)


class Vague(Mine):
    has_scale = True


def test_classes_functions_and_objects_have_names():
    assert type(load_forecaster(f"{NAME}Mine", SPEC, "env 'a'")).__name__ == "Mine"
    assert load_forecaster(f"{NAME}Mine", SPEC, "env 'a'").spec == SPEC
    assert type(make_own(f"{NAME}noisy", SPEC, "env 'a'")).__name__ == "NoisyConstantVelocity"
    assert type(make_own(f"{NAME}ready", SPEC, "env 'a'")).__name__ == "Mine"
    assert name_of_folder(f"{NAME}Mine") == "tests.predictor.test_own_forecasters:Mine"
    assert is_own("own:a:b") and not is_own("highway") and not is_own(Path("own:a:b"))
    require_known(f"{NAME}Mine")
    require_known("constant-velocity")


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("own:nowhere:Mine", "cannot import 'nowhere' for forecaster 'own:nowhere:Mine': No module named 'nowhere'"),
        (f"{NAME}absent", "has no 'absent' for forecaster"),
        (f"{NAME}nothing", "has no 'nothing' for forecaster"),
        (f"{NAME}fails", "calling it with a SceneSpec failed with KeyError: 'weights'"),
        (f"{NAME}number", "but int has no spec"),
        (f"{NAME}coarse", r"coarse' was trained at dt_s=2 but env 'a' steps at dt_s=0.5"),
        (
            "own:absent",
            r"no forecaster 'absent' is registered; installed packages have .* \(entry points of",
        ),
        ("own::", "cannot import ''"),
        ("own:.relative:f", "cannot import '.relative' for forecaster 'own:.relative:f': TypeError: the 'package' arg"),
    ],
)
def test_what_makes_no_forecaster_is_named_in_a_line(name: str, sentence: str):
    with pytest.raises(UserError, match=sentence) as error:
        load_forecaster(name, SPEC, "env 'a'")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "code", ["import sys; sys.exit(3)", "import sys\nclass Mine:\n    def __init__(self, spec): sys.exit(3)"]
)
def test_a_module_that_would_end_the_process_is_named_in_a_line(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "ending.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "ending", raising=False)
    with pytest.raises(UserError, match="ending.*SystemExit: 3"):
        load_forecaster("own:ending:Mine", SPEC, "env 'a'")


def test_it_has_no_weights():
    with pytest.raises(UserError, match="is a forecaster of your own and no checkpoint"):
        resolve(f"{NAME}Mine")
    with pytest.raises(UserError, match="no forecaster 'absent'"):
        require_known("own:absent")


def install(folder: Path, group: str, entry: str) -> None:
    """Writes what pip leaves of a package with an entry point."""
    made = folder / "thirdparty-1.0.dist-info"
    made.mkdir()
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: thirdparty\nVersion: 1.0\n")
    (made / "entry_points.txt").write_text(f"[{group}]\n{entry}\n")


def test_an_installed_package_registers_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    install(tmp_path, GROUP, "mean = thirdparty_mean:Model\nlost = thirdparty_mean:Absent")
    (tmp_path / "thirdparty_mean.py").write_text(
        "from predictor.baselines.constant_velocity import ConstantVelocity\nclass Model(ConstantVelocity):\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "thirdparty_mean" not in sys.modules
    with pytest.raises(UserError, match="no forecaster 'median' is registered; installed packages have .*mean"):
        find_own("own:median")
    assert "thirdparty_mean" not in sys.modules  # listing imports nothing
    assert type(load_forecaster("own:mean", SPEC, "env 'a'")).__name__ == "Model"
    with pytest.raises(UserError, match="forecaster 'lost' cannot be imported from thirdparty_mean:Absent"):
        require_known("own:lost")
    monkeypatch.delitem(sys.modules, "thirdparty_mean")
    (tmp_path / "thirdparty_mean.py").write_text("raise RuntimeError('there is no licence file on this machine')")
    with pytest.raises(UserError, match="'mean' cannot be imported from .*: RuntimeError: there is no licence file"):
        find_own("own:mean")


@pytest.mark.parametrize(
    ("made", "sentence"),
    [
        (Raises, r"^forecaster 'own:a' failed: KeyError: 'weights' \(.*test_own_forecasters.py, line \d+\)$"),
        (Silent, "^forecaster 'own:a' failed: no map of this road; give one$"),
        (Short, "^the forecaster was asked for 1 samples of 3 steps and gave 1 of 2$"),
        (Vague, "^rollout of a forecaster gave no scale, and its has_scale is True; set has_scale = False"),
    ],
)
def test_what_a_forecaster_of_ones_own_does_wrong_is_one_sentence(made: Any, sentence: str):
    watched = WatchedForecaster(made(SPEC), "own:a")
    with pytest.raises(UserError, match=sentence):
        memory, belief = watched.observe(watched.empty_memory(1, 2), torch.zeros(1, 2, 4), torch.ones(1, 2).bool())
        watched.rollout(belief, 3)
