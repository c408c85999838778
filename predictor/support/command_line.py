"""Parsing of a command line into a config: tyro's options, errors in one line.

Configs are checked in `__post_init__`. tyro prints such an error in a box and exits; `parse` raises the error itself,
so that `predictor.support.errors.run_entry_point` prints one line and exits with status 2.
"""

import contextlib
import dataclasses
import io
import itertools
import re
import sys
from collections.abc import Collection, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro
from docstring_parser import parse_from_object

from predictor.support.config_checks import check_numbers
from predictor.support.errors import UserError
from predictor.support.provenance import commit_at_start, program

Config = TypeVar("Config")

HELP_ALL = "--help-all"
"""Option that explains all options of a command."""

_SENTENCE_TITLES = ("Invalid choice", "Missing argument", "Value error")
"""Titles of tyro's boxes whose first part is a sentence; the other boxes list options and stay as they are."""
_UNKNOWN = "Unrecognized options"
_NOT_A_NUMBER = (
    (r"no type matching \{None\}\|INT could be instantiated from \['(.*)'\]\.?", "a whole number"),
    (r"no type matching \{None\}\|FLOAT could be instantiated from \['(.*)'\]\.?", "a number"),
    (r"invalid literal for int\(\) with base 10: '(.*)'", "a whole number"),
    (r"could not convert string to float: '(.*)'", "a number"),
)
"""Sentences of tyro and of Python about a word that is no number, and what it has to be."""


def parse(config_class: type[Config], description: str | None = None, args: Sequence[str] | None = None) -> Config:
    """Reads a config from the command line.

    `--help` lists the fields that the class names in `EVERYDAY`, `--help-all` all of them; a class without it has no
    others.

    Args:
        config_class: dataclass with a string under every field.
        description: text at the head of `--help`.
        args: words of the command line; None takes those of this process.

    Raises:
        UserError: the config rejects a value, a value does not have its field's type, an option is unknown, or one that
            takes several values is given twice.
        SystemExit: options are missing (status 2, listed on stderr), or help is asked for (status 0).
    """
    words = sys.argv[1:] if args is None else list(args)
    if HELP_ALL in words:
        words = ["--help"]
        config_class = _for_help(config_class, ())
    elif {"-h", "--help"} & set(words):
        if hidden := _seldom_used(config_class):
            description = f"{(description or '').strip()}\n\n{len(hidden)} more options: {HELP_ALL}."
        config_class = _for_help(config_class, hidden)
    _check_given_once(config_class, words)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            config = tyro.cli(config_class, prog=" ".join(program()), description=description, args=words)
    except SystemExit as leaving:
        if (error := _user_error_behind(leaving)) is not None:
            raise error from None
        if sentence := _sentence_in(printed.getvalue()):
            raise UserError(sentence) from None
        print(printed.getvalue(), end="", file=sys.stderr)
        raise
    check_numbers(config)
    commit_at_start()
    return config


def _check_given_once(config_class: type, words: Sequence[str]) -> None:
    """Checks that no option with several values is given twice: the later one would silently replace the earlier one.

    Raises:
        UserError: one is.
    """
    hints = get_type_hints(config_class)
    several = {name.replace("_", "-") for name, hint in hints.items() if _is_tuple(hint)}
    given = [word[2:].partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    for name in given:
        if name in several and given.count(name) > 1:
            raise UserError(f"--{name} is given {given.count(name)} times; give all its values after one: --{name} A B")


def _is_tuple(hint: Any) -> bool:
    return get_origin(hint) is tuple or any(map(_is_tuple, get_args(hint)))


def _seldom_used(config_class: type) -> list[str]:
    """Returns the names of the fields that a class does not name as everyday ones."""
    everyday = getattr(config_class, "EVERYDAY", None)
    return [field.name for field in fields(config_class) if everyday is not None and field.name not in everyday]


def _for_help(config_class: Any, hidden: Collection[str]) -> Any:
    """Returns a class whose help leaves out fields, and breaks the lines of the others' strings at the width alone."""
    hints = get_type_hints(config_class, include_extras=True)
    bases = reversed(config_class.__mro__[:-1])
    texts = {one.arg_name: one.description or "" for base in bases for one in parse_from_object(base).params}
    content: dict[str, Any] = {"__annotations__": {}}
    for place in fields(config_class):
        shown: Any = tyro.conf.arg(help=" ".join(texts.get(place.name, "").split()))
        content["__annotations__"][place.name] = Annotated[
            hints[place.name], tyro.conf.Suppress if place.name in hidden else shown
        ]
        if place.default_factory is not MISSING:
            content[place.name] = dataclasses.field(default_factory=place.default_factory)
        elif place.default is not MISSING:
            content[place.name] = place.default
    return dataclass(frozen=True)(type(config_class.__name__, (config_class,), content))


def _user_error_behind(error: BaseException | None) -> UserError | None:
    """Returns the `UserError` during whose handling this exception was raised; None if there is none."""
    while error is not None and not isinstance(error, UserError):
        error = error.__context__
    return error


def _sentence_in(box: str) -> str:
    """Returns the sentence in a box of tyro, without the frame; empty for a box that lists options."""
    lines = re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()
    title = lines[0].strip("╭─╮+- ") if lines else ""
    inside = [line.strip("│ ") for line in lines[1:]]
    after_title = itertools.dropwhile(_is_rule, inside)
    sentence = " ".join(itertools.takewhile(lambda line: not _is_rule(line), after_title))
    if title == _UNKNOWN:
        options = (re.match(r"[│ ] {5}(--\S+)", line) for line in lines)  # their help is further in
        similar = [option[1] for option in options if option]
        meant = f"did you mean {' or '.join(similar)}? " if similar else ""
        return f"unknown options: {sentence.removeprefix(_UNKNOWN + ': ')}; {meant}--help lists those that there are"
    return _plainly(sentence.removeprefix("Error parsing ")) if title in _SENTENCE_TITLES else ""


def _plainly(sentence: str) -> str:
    """Returns a sentence on a wrong word in ours, if it is that the word is no number."""
    for pattern, wanted in _NOT_A_NUMBER:
        if found := re.fullmatch(rf"(\S+): {pattern}", sentence):
            return f"{found[1]} must be {wanted}, got {found[2]!r}"
    return sentence


def _is_rule(line: str) -> bool:
    """Returns whether a line of a box is empty or a rule; tyro uses ASCII if stdout has nothing else."""
    return not line.strip("╰╯─-")
