"""Self-attention over current and history Gaussians (method 6.3)."""

import math

import torch
import torch.nn.functional as F

from src.models.horizon3d.temporal_attention import TemporalSelfAttention
from src.structures.gaussians import GaussianSet

CHANNELS, HEADS = 16, 4


def make_set(b=2, g=9, history=4, dtype=torch.float32):
    """Random features and embeddings; the last `history` Gaussians are half a second and a second old."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    ages = torch.zeros(b, g, dtype=dtype)
    ages[:, g - history :] = 0.5 * (1 + torch.arange(history) % 2)
    valid = torch.rand(b, g, generator=generator) < 0.7
    valid[:, 0] = True
    gaussians = GaussianSet(
        **{name: draw(b, g, 2) for name in ("means", "scales", "directions", "velocities")},
        opacity_logits=draw(b, g),
        features=draw(b, g, CHANNELS),
        sources=torch.where(ages > 0, 3, 0),
        elapsed_s=ages,
        valid=valid,
    )
    return gaussians.features, draw(b, g, CHANNELS), gaussians


def lively(seed=0, dtype=torch.float32):
    """As trained: no weight is zero any more."""
    torch.manual_seed(seed)
    attention = TemporalSelfAttention(CHANNELS, HEADS)
    with torch.no_grad():
        for parameter in attention.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return attention.to(dtype)


def double_time(attention):
    """The time embedding in float64; the module's own rounds to float32 first."""
    attention.time.forward = lambda ages: attention.time.mlp(ages[..., None])
    return attention


def test_untrained_it_adds_exactly_zero():
    torch.manual_seed(0)
    attention = TemporalSelfAttention(CHANNELS, HEADS)
    features, embedding, gaussians = make_set()
    assert torch.equal(attention(features, embedding, gaussians), torch.zeros_like(features))
    attention(features, embedding, gaussians).sum().backward()
    assert attention.output.weight.grad.any()  # and still learns


def test_it_is_torchs_multi_head_attention():
    attention = double_time(lively(dtype=torch.float64))
    features, embedding, gaussians = make_set(dtype=torch.float64)
    x = F.layer_norm(features, (CHANNELS,), attention.norm.weight, attention.norm.bias)
    time = attention.time.mlp(gaussians.elapsed_s[..., None])
    time[gaussians.elapsed_s == 0] = 0.0
    position = (x + embedding + time).transpose(0, 1)  # [G, B, C]
    expected, _ = F.multi_head_attention_forward(
        position,
        position,
        x.transpose(0, 1),
        CHANNELS,
        HEADS,
        in_proj_weight=torch.cat([attention.query_key.weight, attention.value.weight]),
        in_proj_bias=torch.cat([attention.query_key.bias, attention.value.bias]),
        bias_k=None,
        bias_v=None,
        add_zero_attn=False,
        dropout_p=0.0,
        out_proj_weight=attention.output.weight,
        out_proj_bias=attention.output.bias,
        key_padding_mask=~gaussians.valid,
    )
    torch.testing.assert_close(attention(features, embedding, gaussians), expected.transpose(0, 1))


def test_one_query_by_a_plain_loop():
    attention = double_time(lively(1, torch.float64))
    features, embedding, gaussians = make_set(b=1, g=5, history=2, dtype=torch.float64)
    gaussians.valid[0] = torch.tensor([True, False, True, True, True])
    x = attention.norm(features)[0]
    position = x + embedding[0]
    for row in (3, 4):
        position[row] = position[row] + attention.time.mlp(gaussians.elapsed_s[0, row : row + 1])
    query, key = attention.query_key(position).split(CHANNELS, dim=1)
    value = attention.value(x)
    width, mixed = CHANNELS // HEADS, []
    for head in range(HEADS):
        part = slice(head * width, (head + 1) * width)
        scores = [(query[2, part] @ key[row, part]).item() / math.sqrt(width) for row in range(5)]
        weights = [math.exp(score) if row != 1 else 0.0 for row, score in enumerate(scores)]
        mixed.append(sum(w * value[row, part] for row, w in enumerate(weights)) / sum(weights))
    expected = attention.output(torch.cat(mixed))
    torch.testing.assert_close(attention(features, embedding, gaussians)[0, 2], expected)


def test_padding_is_never_looked_at():
    attention = lively()
    features, embedding, gaussians = make_set()
    before = attention(features, embedding, gaussians)
    padding = ~gaussians.valid
    features, embedding = features.clone(), embedding.clone()
    features[padding], embedding[padding] = 100.0, -50.0
    gaussians.elapsed_s[padding] = 3.0
    after = attention(features, embedding, gaussians)
    torch.testing.assert_close(after[gaussians.valid], before[gaussians.valid], atol=1e-6, rtol=1e-6)


def test_history_is_looked_at():
    attention = lively()
    features, embedding, gaussians = make_set()
    gaussians.valid[:] = True
    before = attention(features, embedding, gaussians)
    gaussians.valid[:, -4:] = False
    assert (attention(features, embedding, gaussians) - before)[:, :5].abs().max() > 1e-3


def test_samples_do_not_mix():
    attention = lively()
    features, embedding, gaussians = make_set()
    both = attention(features, embedding, gaussians)
    alone = attention(features[1:], embedding[1:], gaussians.map(lambda value: value[1:]))
    torch.testing.assert_close(both[1:], alone)


def test_a_sample_without_any_gaussian_stays_finite():
    attention = lively()
    features, embedding, gaussians = make_set()
    gaussians.valid[0] = False
    features.requires_grad_(True)
    result = attention(features, embedding, gaussians)
    assert result.isfinite().all()
    result[gaussians.valid].sum().backward()
    assert features.grad.isfinite().all() and not features.grad[0].any()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in attention.parameters())


def test_the_current_frame_has_no_time_embedding():
    """Zero, not an embedded zero: without history the time MLP is of no influence, but has a gradient for DDP."""
    attention = lively()
    features, embedding, gaussians = make_set(history=0)
    before = attention(features, embedding, gaussians)
    before.sum().backward()
    assert all(p.grad is not None and not p.grad.any() for p in attention.time.parameters())
    with torch.no_grad():
        for parameter in attention.time.parameters():
            parameter.add_(1.0)
    assert torch.equal(attention(features, embedding, gaussians), before)


def test_ages_tell_history_apart():
    attention = lively()
    features, embedding, gaussians = make_set()
    before = attention(features, embedding, gaussians)
    gaussians.elapsed_s[:, -4:] *= 2
    assert (attention(features, embedding, gaussians) - before).abs().max() > 1e-4


def test_under_autocast():
    attention = lively()
    features, embedding, gaussians = make_set()
    with torch.autocast("cpu", torch.bfloat16):
        half = attention(features, embedding, gaussians)
    assert (half.float() - attention(features, embedding, gaussians)).abs().max() < 0.15
