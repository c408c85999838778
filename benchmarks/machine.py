"""Measures the rate of plain matrix products on this machine, which other lines are compared with."""

from benchmarks.results import Line
from benchmarks.settings import Settings
from benchmarks.timing import REFERENCE_PRODUCTS, Meter, Product, products, quartiles

SQUARE: Product = (1024, 1024, 1024)
"""Shape of a large square product, which reaches the highest rate; thin products are slower."""


def run(settings: Settings) -> list[Line]:
    """Measures GFLOP/s of each reference product, of all of them together, and of a large square one."""
    shapes = [*((shape,) for shape in REFERENCE_PRODUCTS), (SQUARE,), REFERENCE_PRODUCTS]
    yards = {_name(s): products(tuple(s)) for s in shapes}
    timings = Meter.of(settings).measure({name: yard.call for name, yard in yards.items()})
    lines = []
    for name, yard in yards.items():
        rates = yard.flop / timings[name].seconds / 1e9
        median = yard.flop / timings[name].median
        share = timings[name].matmul_share(yard.flop)
        lines.append(
            Line("machine", "float32 product", {"m×k×n": name}, median / 1e9, "GFLOP/s", quartiles(rates),
                flop=yard.flop, flops_per_s=median, matmul_share=share)
        )  # fmt: skip
    return lines


def _name(shapes: tuple[Product, ...]) -> str:
    return "×".join(map(str, shapes[0])) if len(shapes) == 1 else "all four: the matmul rate"
