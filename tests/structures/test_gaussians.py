import pytest
import torch

from src.structures.gaussians import GaussianSet, Source


def gaussians(count=5, source=Source.RADAR, **changes):
    values = {name: torch.randn(2, count, 2) for name in ("means", "scales", "directions", "velocities")}
    values |= {name: torch.randn(2, count) for name in ("opacity_logits", "elapsed_s")}
    values |= {
        "features": torch.randn(2, count, 8),
        "sources": torch.full((2, count), int(source)),
        "valid": torch.ones(2, count, dtype=torch.bool),
    }
    return GaussianSet(**(values | changes))


def test_sets_are_joined_along_the_gaussians():
    parts = [gaussians(3), gaussians(0, Source.CAMERA), gaussians(2, Source.HISTORY)]
    joined = GaussianSet.concatenate(parts)
    assert len(joined) == 5 and joined.batch_size == 2
    assert joined.sources.tolist() == [[0, 0, 0, 3, 3]] * 2
    assert torch.equal(joined.features[:, 3:], parts[2].features)


@pytest.mark.parametrize(
    "name, value",
    [
        ("means", torch.zeros(2, 5, 3)),
        ("scales", torch.zeros(2, 4, 2)),
        ("opacity_logits", torch.zeros(2, 5, 1)),
        ("features", torch.zeros(1, 5, 8)),
        ("elapsed_s", torch.zeros(2)),
        ("valid", torch.ones(2, 5)),
    ],
)
def test_what_does_not_fit_is_named(name, value):
    with pytest.raises(ValueError, match=f"GaussianSet.{name} must be"):
        gaussians(**{name: value})
