"""Operations are classified by name, and shares add up."""

import pytest
import torch

from benchmarks.time_shares import KINDS, kind_of, shares


@pytest.mark.parametrize(
    ("operation", "kind"),
    [
        ("aten::addmm", "products"),
        ("mkldnn::_linear_pointwise", "products"),
        ("aten::elu_backward", "ELU, gates"),
        ("aten::index_select", "lookups, sums over senders"),
        ("aten::copy_", "rest"),
    ],
)
def test_kinds(operation: str, kind: str):
    assert kind_of(operation) == kind


def test_shares_of_a_call_that_is_nearly_all_products():
    matrix = torch.randn(300, 300)
    spent, operations = shares(lambda: matrix @ matrix, 3)
    assert set(spent) == {*KINDS, "rest"} and sum(spent.values()) == pytest.approx(1)
    assert spent["products"] > 0.5 and 1 <= operations < 10
