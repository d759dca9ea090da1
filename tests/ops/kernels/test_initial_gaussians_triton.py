import pytest
import torch

from src.ops.gaussian_shapes import AttributeLimits
from src.ops.initial_gaussians import Attributes, Keypoints, Slots, initial_gaussians, initial_gaussians_reference

LIMITS = AttributeLimits((0.2, 3.0), 4.0, 30.0, 10.0)


@pytest.mark.parametrize("channels", [5, 16])
@pytest.mark.parametrize("kept", [None, 0, 7])
@pytest.mark.parametrize(("found", "learnt", "changed"), [((6, 3), 4, True), ((6, 3), 0, False), ((), 5, False)])
def test_gaussians_of_all_sources(device, channels, kept, found, learnt, changed):
    draw = torch.Generator().manual_seed(0)

    def normal(*size):
        return torch.randn(*size, generator=draw)

    def mask(*size):
        return torch.rand(*size, generator=draw) > 0.4

    num = sum(found) + learnt
    slots = Slots(normal(num, channels + 7), torch.arange(num) // 4, normal(learnt, 2), normal(channels))
    slots.values[:1, channels + 2 : channels + 4] = 0.0  # no direction at all
    keypoints = [
        Keypoints(20 * normal(2, n, 3)[..., :2], mask(2, n), normal(2, n, channels + 7) if changed else None)
        for n in found
    ]
    history = None
    if kept is not None:
        pairs, singles = [normal(2, kept, 2) for _ in range(4)], [normal(2, kept) for _ in range(2)]
        sources, features = torch.full((2, kept), 3), normal(2, kept, channels).bfloat16()
        history = Attributes(*pairs[:3], singles[0], pairs[3], features, sources, singles[1], mask(2, kept))
    centre = torch.tensor([1.0, -2.0])
    wanted = initial_gaussians_reference(slots, keypoints, history, centre, LIMITS, 2)

    def placed(x):
        return None if x is None else x.to(device)

    result = initial_gaussians(
        Slots(*(placed(x) for x in (slots.values, slots.sources, slots.learnt_means, slots.history_shift))),
        [Keypoints(placed(one.means), placed(one.valid), placed(one.change)) for one in keypoints],
        None if history is None else Attributes(*(placed(x) for x in history)),
        placed(centre), LIMITS, 2,
    )  # fmt: skip
    for value, expected in zip(result, wanted, strict=True):
        assert value.dtype == expected.dtype
        torch.testing.assert_close(value.cpu(), expected, rtol=1e-5, atol=1e-5)
