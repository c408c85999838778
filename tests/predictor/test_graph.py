import torch

from predictor.graph import PairLinear, pair_mask, sum_over_senders


def test_pair_mask_closed_form():
    valid = torch.tensor([[True, True, False], [False, False, False]])
    expected = torch.zeros(2, 3, 3, dtype=torch.bool)
    expected[0, 0, 1] = expected[0, 1, 0] = True
    assert torch.equal(pair_mask(valid), expected)


def test_pair_mask_of_one_agent_is_empty():
    assert not pair_mask(torch.tensor([True])).any()


def test_pair_linear_is_a_linear_layer_on_the_concatenation():
    torch.manual_seed(0)
    layer, nodes = PairLinear(3, 5), torch.randn(2, 4, 3)
    whole = torch.nn.Linear(6, 5)
    whole.weight.data = torch.cat([layer.receiver.weight, layer.sender.weight], dim=1)
    whole.bias.data = layer.receiver.bias.data
    pairs = layer(nodes)
    for i in range(4):
        for j in range(4):
            expected = whole(torch.cat([nodes[:, i], nodes[:, j]], dim=-1))
            torch.testing.assert_close(pairs[:, i, j], expected)


def test_relative_pair_linear_is_the_edge_convolution():
    torch.manual_seed(0)
    layer, nodes = PairLinear(3, 5, relative=True), torch.randn(4, 3)
    whole = torch.nn.Linear(6, 5)
    whole.weight.data = torch.cat([layer.receiver.weight, layer.sender.weight], dim=1)
    whole.bias.data = layer.receiver.bias.data
    pairs = layer(nodes)
    for i in range(4):
        for j in range(4):
            expected = whole(torch.cat([nodes[i], nodes[j] - nodes[i]], dim=-1))
            torch.testing.assert_close(pairs[i, j], expected)


def test_sum_over_senders_against_a_loop():
    generator = torch.Generator().manual_seed(0)
    pairs, weight = torch.randn(2, 4, 4, 3, generator=generator), torch.rand(2, 4, 4, generator=generator)
    expected = torch.zeros(2, 4, 3)
    for b in range(2):
        for receiver in range(4):
            for sender in range(4):
                expected[b, receiver] += weight[b, receiver, sender] * pairs[b, receiver, sender]
    torch.testing.assert_close(sum_over_senders(pairs, weight), expected)
