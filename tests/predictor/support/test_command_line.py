import sys
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec
from typing import ClassVar, Literal

import pytest

from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point


@dataclass(frozen=True)
class Box:
    """Size of a box."""

    width: int = 1
    """Width of the box."""

    def __post_init__(self) -> None:
        check_at_least(self, 1, "width")


@dataclass(frozen=True)
class Settings:
    """Settings of a test."""

    num_envs: int | None = 2
    """Number of environments."""
    out_paths: tuple[str, ...] = ()
    """Folders to write."""
    record: bool = True
    """Film it."""
    colour: Literal["red", "blue"] = "red"
    """Colour of the box."""
    box: Box = field(default_factory=Box)
    """Box itself."""
    share: float | None = None
    """Share of
    --num-envs that is red."""

    def __post_init__(self) -> None:
        check_at_least(self, 1, "num_envs")


@dataclass(frozen=True)
class Long:
    """Settings of which few are changed often."""

    EVERYDAY: ClassVar = ("colour", "num_envs")

    colour: Literal["red", "blue"] = "red"
    """Colour of the box."""
    num_envs: int = 2
    """Number of environments."""
    curl: float = 0.5
    """Curl of the field."""
    spin: int | None = None
    """Spin of the field."""


def test_help_explains_the_everyday_options_and_help_all_every_one(capsys: pytest.CaptureFixture[str]):
    shown = {}
    for word in ("-h", "--help", "--help-all"):
        with pytest.raises(SystemExit) as stop:
            parse(Long, "Turns a box.", args=["--colour", "blue", word] if word != "--help-all" else [word])
        assert stop.value.code == 0
        shown[word] = capsys.readouterr().out
    assert shown["-h"] == shown["--help"]
    assert "Colour of the box." in shown["-h"] and "Number of environments." in shown["-h"]
    assert "curl" not in shown["-h"] and "2 more options: --help-all." in shown["-h"]
    assert all(
        text in shown["--help-all"] for text in ("Colour of the box.", "Curl of the field.", "Spin of the field.")
    )
    assert "more options" not in shown["--help-all"]
    assert parse(Long, args=["--curl", "1", "--num-envs", "3"]) == Long(num_envs=3, curl=1.0), "all of them are read"


def test_a_module_is_called_by_its_name(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    main = sys.modules["__main__"]
    monkeypatch.setattr(main, "__file__", "/somewhere/of/ours.py", raising=False)
    monkeypatch.setattr(main, "__spec__", ModuleSpec("of.ours", None))
    for first, name in (("/somewhere/of/ours.py", "python -m of.ours"), ("dgvae turn", "dgvae turn")):
        monkeypatch.setattr(sys, "argv", [first])
        with pytest.raises(SystemExit):
            parse(Long, args=["--help"])
        assert capsys.readouterr().out.startswith(f"usage: {name} [-h]")


def test_words_become_a_config(capsys: pytest.CaptureFixture[str]):
    words = ["--num-envs", "3", "--out-paths", "a", "b", "--no-record", "--colour", "blue", "--box.width", "4"]
    assert parse(Settings, args=words) == Settings(3, ("a", "b"), False, "blue", Box(4))
    assert capsys.readouterr() == ("", "")


def test_the_words_of_the_process_are_read_by_default(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["command", "--num-envs", "5"])
    assert parse(Settings).num_envs == 5


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--num-envs", "0"], "num_envs must be at least 1, got 0"),
        (["--box.width", "-1"], "width must be at least 1, got -1"),
        (["--colour", "green"], "invalid choice 'green' for argument '--colour'. Expected one of ('red', 'blue')."),
        (["--box.width", "1.5"], "--box.width must be a whole number, got '1.5'"),
        (["--num-envs", "1e9"], "--num-envs must be a whole number, got '1e9'"),
        (["--share", "much"], "--share must be a number, got 'much'"),
        (["--shares", "a"], "unknown options: --shares, a; did you mean --share? --help lists those that there are"),
        (["--purple", "3"], "unknown options: --purple, 3; --help lists those that there are"),
        (["--box.width"], "Missing value for argument '--box.width'. Expected 1 values."),
    ],
)
@pytest.mark.parametrize("columns", ["40", "80", "200"])
def test_a_refused_value_is_one_line(
    words: list[str],
    line: str,
    columns: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr(sys, "argv", ["command", *words])
    with pytest.raises(SystemExit) as stop:
        run_entry_point(lambda: print(parse(Settings)))
    assert stop.value.code == 2
    assert capsys.readouterr() == ("", f"error: {line}\n")


def test_the_error_of_the_config_itself_is_raised():
    with pytest.raises(UserError) as error:
        parse(Settings, args=["--box.width", "0"])
    assert error.value.__suppress_context__ and not isinstance(error.value.__cause__, SystemExit)


def test_of_options_that_do_not_exist_similar_ones_are_named():
    with pytest.raises(UserError, match="^unknown options: --num-env, 3; did you mean --num-envs"):
        parse(Settings, args=["--num-env", "3"])


@dataclass(frozen=True)
class Wordy:
    """Settings with long strings, of which one is required."""

    path: str
    """Path of the
    file."""
    sizes: list[int] = field(default_factory=lambda: [1, 2])
    """Sizes, the smallest
    first."""


@pytest.mark.parametrize("word", ["--help", "--help-all"])
def test_lines_of_help_break_at_the_width_alone(word: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        parse(Wordy, args=[word])
    out = capsys.readouterr().out
    assert "Path of the file. (required)" in out and "Sizes, the smallest first. (default: 1 2)" in out
    assert parse(Wordy, args=["--path", "a"]) == Wordy("a", [1, 2])


def test_help_has_the_description_and_every_field(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        parse(Settings, "Reads settings.", args=["--help"])
    out, errors = capsys.readouterr()
    assert stop.value.code == 0 and errors == ""
    for text in ("Reads settings.", "--num-envs", "Number of environments.", "--box.width", "Width of the box."):
        assert text in out


@pytest.mark.parametrize("again", ["--out-paths", "--out_paths", "--out-paths=c"])
def test_an_option_with_several_values_is_given_once(again: str):
    """The later one would silently replace the earlier one; of a single value the last one counts, as elsewhere."""
    words = ["--num-envs", "3", "--num-envs", "4", "--out-paths", "a", again, *([] if "=" in again else ["b"])]
    with pytest.raises(
        UserError, match=r"--out-paths is given 2 times; give all its values after one: --out-paths A B"
    ):
        parse(Settings, args=words)
    assert parse(Settings, args=words[:6]) == Settings(4, ("a",))
