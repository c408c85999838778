"""Inputs that look bad and are accepted, or end otherwise, on purpose: patterns of titles, verdicts, and reasons."""

import re
from functools import cache

_ZERO = (
    "at-step batch-size branches causal-labels curriculum-steps edge-cost edge-probability energy-weight "
    "episode-steps episodes frame-step hidden-draws joint-energy-weight kicks kl-warmup-steps kl-weight label-weight "
    "max-episodes max-windows min-history-steps one-step-weight ood peak-tflops perturb reaction-weight replaced "
    "rollout-weight seed share shift-weight steps test threads train type-label-weight val workers"
).split()

ARGUED: tuple[tuple[str, str, str], ...] = (
    (r".*: --[a-z-]+ '９'", "silent", "Python reads digits of every script, and the value is the one that is shown"),
    (
        rf".*: --({'|'.join(_ZERO)}) '0'",
        "silent",
        "0 has a meaning, which --help says: none, all, the default, or no weight; a seed may be 0",
    ),
    (r"predictor\.train: --horizon-steps '0'", "silent", "0 takes the default, or the horizon of `--init`"),
    (
        r".*: --(extra-columns|memory-steps|neighbours) '--'",
        "silent",
        "'--' ends a list of values: none are given, as where the option is left out",
    ),
    (
        r"predictor\.data\.crowd: --episode-steps '９'",
        "unclear",
        "the default of at_step does not fit so few steps, and the line says so",
    ),
    (
        r"HOME=(absent|fifo|): .*",
        "files changed",
        "libraries write their caches below HOME, and make the folder; nothing of ours is written",
    ),
    (
        r"(HOME|MPLCONFIGDIR|PYTHONHASHSEED|TMPDIR)=.*: envs.collect",
        "unclear",
        "Python or a library warns before our line where a worker starts, or none can start, and the line says so",
    ),
    (
        r"(MPLBACKEND|SOURCE_DATE_EPOCH)=.*: envs.collect",
        "traceback",
        "highway-env imports matplotlib, which refuses the variable before any line of ours, and names it or its value",
    ),
    (
        r"OMP_NUM_THREADS=.*",
        "unclear",
        "OpenMP's own warning stands before the line where a worker starts; the line itself is as ever",
    ),
    (
        r"envs.evaluate: --driver ''",
        "silent",
        "an empty text is the default: the environment's own driver",
    ),
    (
        r"(load_|read_|make_).*: (5|None|b'x'|\{\})",
        "traceback",
        "a path or id of another type is a mistake in the caller's program; Python's TypeError names the type",
    ),
    (
        r"read_curve: (file/below|xxx.*|a\x00b)",
        "silent",
        "there can be no such file, so the training has no measurements yet",
    ),
    (
        r".*: seed=1000000.*",
        "silent",
        "NumPy's generators take whole numbers of any size as seeds",
    ),
    (
        r"ForecastObservation: forecaster=highway",
        "silent",
        "forecaster= takes what checkpoint= takes, a name included; the forecast is that of the name",
    ),
    (
        r"what_if: plans are an error",
        "traceback",
        "an error of a user's own code in a user's own program comes as it is",
    ),
)
"""Pattern of titles, how the input ends, and why that is fine."""


@cache
def _patterns() -> tuple[tuple[re.Pattern[str], str, str], ...]:
    return tuple((re.compile(pattern), verdict, reason) for pattern, verdict, reason in ARGUED)


def reason_of(title: str, verdict: str) -> str:
    """Returns why an outcome is fine; empty if nothing says so."""
    found = (reason for pattern, known, reason in _patterns() if known == verdict and pattern.fullmatch(title))
    return next(found, "")
