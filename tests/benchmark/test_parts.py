"""Parts alone with the inputs that they have within the model: nothing shared with it, nothing left behind."""

from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor, nn

from src.benchmark.parts import backward_from, fresh, is_within, parts_of, record_calls, tensors_in


@dataclass
class Bundle:
    value: Tensor
    twin: Tensor
    cache: dict = field(default_factory=dict)


class Part(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(3, 3)

    def forward(self, bundle):
        bundle.cache.setdefault("seen", torch.zeros(1))
        return [self.layer(bundle.value), bundle.cache["seen"]]

    def decode(self, output):
        return output[0].argmax(1)


class Whole(nn.Module):
    benchmark_parts = {"second: itself": ("second.forward",)}

    def __init__(self):
        super().__init__()
        self.first, self.second = nn.Linear(3, 3), Part()

    def forward(self, x):
        value = self.first(x)
        return self.second(Bundle(value, value))


def test_parts_are_children_by_the_methods_they_have():
    assert parts_of(Whole()) == {
        "first": ("first.forward",), "second": ("second.forward",), "second: itself": ("second.forward",),
        "second: decode": ("second.decode",)
    }  # fmt: skip
    assert is_within("ocsf: splat") and not is_within("ocsf") and not is_within("head: decode")


def test_a_recorded_call_is_made_again_with_the_caches_of_the_first_time():
    model, x = Whole(), torch.randn(4, 3)
    parts = {"second": ("second.forward",), "second: itself": ("second.forward",), "absent": ("third.forward",)}
    calls = record_calls(model, parts, lambda: model(x))
    assert list(calls) == ["second", "second: itself"] and not hasattr(model.second.forward, "plain_function")
    (call,) = calls["second"]
    (bundle,) = call.arguments
    assert bundle.value is bundle.twin and bundle.value.requires_grad and bundle.value.is_leaf
    assert bundle.cache == {}  # the call filled that of the model, and later ones their own
    again = call.prepare()()
    torch.testing.assert_close(again[0], call.result[0])
    assert bundle.cache == {}
    assert backward_from(again) and model.second.layer.weight.grad is not None
    assert model.first.weight.grad is None  # no history beyond the part's inputs


def test_a_part_whose_method_is_gone_is_not_left_out_silently():
    with pytest.raises(AttributeError, match="decoded"):
        record_calls(Whole(), {"second": ("second.decoded",)}, lambda: None)


def test_a_result_without_history_has_no_backward():
    assert not backward_from([torch.zeros(2), "text", None])


def test_tensors_are_found_outside_caches():
    a, b = torch.zeros(1), torch.zeros(2)
    assert [x is y for x, y in zip(tensors_in([Bundle(a, b, {"c": torch.zeros(3)}), (a,)]), [a, b], strict=True)]


@pytest.mark.parametrize("wanted", [True, False])
def test_fresh_tensors_share_numbers_but_no_history(wanted):
    x = torch.randn(3, requires_grad=wanted) * 2
    made = fresh({"x": x, "n": 3, "pair": (x, torch.Size([1, 2]))})
    assert made["x"].data_ptr() == x.data_ptr() and made["x"] is made["pair"][0]
    assert made["x"].is_leaf and made["x"].requires_grad == wanted
    assert made["n"] == 3 and made["pair"][1] == torch.Size([1, 2])
