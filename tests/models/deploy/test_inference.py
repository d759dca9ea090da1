"""The detector prepared for inference against the one that was trained: layers, streams with memory, fixed shapes."""

import shutil
from dataclasses import fields, replace
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.deploy.inference import fold_norm, prepare_for_inference
from src.models.deploy.static_parts import GraphReplay, ImageNetwork
from src.models.heads.branches import Branches, MergedBranches
from src.models.horizon3d.gaussian_encoder import AnchorEncoder, GaussianBounds
from src.models.horizon3d.sparse_fusion import SparseFusion
from src.models.layers.sparse import RowBatchNorm, SparseConv, SubmanifoldConv
from src.ops.precision import computing
from src.ops.sites import Sites
from src.streaming import StreamingDetector
from src.structures.boxes import Boxes3D
from src.structures.sparse_bev import SparseBEV
from tests.test_streaming import make_frame
from tests.untrained import write_checkpoint

FRAMES = 12  # the memory holds 8


def stir(model, seed=0):
    """Give every batch norm statistics and weights that a training could have left."""
    generator = torch.Generator().manual_seed(seed)
    for module in model.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            shape = module.running_mean.shape
            module.running_mean.copy_(0.2 * torch.randn(shape, generator=generator))
            module.running_var.copy_(0.5 + torch.rand(shape, generator=generator))
            with torch.no_grad():
                module.weight.add_(0.2 * torch.randn(shape, generator=generator))
                module.bias.add_(0.1 * torch.randn(shape, generator=generator))
    return model


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Plain detectors by what they are, made once."""
    folder, made = tmp_path_factory.mktemp("trained"), {}

    def get(*overrides):
        if overrides not in made:
            path = write_checkpoint(folder / f"{len(made)}.ckpt", *overrides)
            made[overrides] = StreamingDetector.load(path, plain=True)
            stir(made[overrides].model)
        return made[overrides]

    return get


def pair(detector, precision="32-true", **switches):
    """Two fresh detectors of one model: as trained and prepared."""
    parts = (detector.model, detector.grid, detector.settings)
    plain = StreamingDetector(*parts, precision=precision, plain=True)
    return plain, StreamingDetector(*parts, precision=precision, **switches)


def distance(found: Boxes3D, wanted: Boxes3D) -> torch.Tensor:
    """For each wanted box the difference to the most similar found one of its class, m, m/s, rad and score together."""

    def code(boxes):
        heading = torch.stack([boxes.yaws.cos(), boxes.yaws.sin()], 1)
        return torch.cat([boxes.centers, boxes.sizes, heading, boxes.velocities, 10 * boxes.scores[:, None]], 1)

    gaps = (code(wanted)[:, None] - code(found)[None]).abs().amax(2)
    return torch.where(wanted.labels[:, None] == found.labels, gaps, torch.inf).amin(1)


LAYERS = {
    "conv": lambda bias: nn.Conv2d(6, 5, 3, padding=1, bias=bias),
    "transposed": lambda bias: nn.ConvTranspose2d(6, 5, 2, 2, bias=bias),
    "linear": lambda bias: nn.Linear(6, 5, bias=bias),
    "submanifold": lambda bias: SubmanifoldConv(6, 5, 3, 2, bias=bias),
    "strided": lambda bias: SparseConv(6, 5, 3, 2, bias=bias, stride=2),
}


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("name", LAYERS)
def test_a_folded_norm_is_the_layer_and_the_norm(name, bias):
    torch.manual_seed(0)
    layer = LAYERS[name](bias)
    dense = isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)
    norm = stir(nn.BatchNorm2d(5) if dense else RowBatchNorm(5, eps=1e-3)).eval()
    sites, _ = Sites.unique(torch.randint(0, 8, (40, 3)) % torch.tensor([2, 8, 8]), (2, 8, 8))
    x = torch.randn(2, 6, 8, 8) if dense else torch.randn(len(sites), 6)
    if name in ("submanifold", "strided"):
        x = SparseBEV(sites, x)

    def run():
        y = layer(x)
        return y.features if isinstance(y, SparseBEV) else y

    wanted = norm(run())
    fold_norm(layer, norm)
    torch.testing.assert_close(run(), wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("rows", [0, 1, 1300])
def test_merged_branches_equal_each_alone(rows):
    torch.manual_seed(0)
    branches = [stir(Branches(8, widths), seed).eval() for seed, widths in enumerate([(2,), (1, 3), (4,)])]
    x = torch.randn(rows, 8)
    wanted = torch.cat([one(x) for one in branches], dim=1)
    for one in branches:
        fold_norm(one.hidden, one.norm)
    torch.testing.assert_close(MergedBranches(branches)(x), wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("count", [0, 6])
def test_a_merged_anchor_encoder_equals_its_parts(count):
    grid = BEVGrid(cells=(8, 8), cell_m=0.8, centre_m=(1.0, 0.0), z_range_m=(-3.0, 5.0))
    anchor = AnchorEncoder(4, grid, GaussianBounds((0.5, 4.0), 2.0, 40.0, 10.0)).double()
    for parameter in anchor.parameters():
        nn.init.normal_(parameter)
    names = {"means": (2,), "scales": (2,), "directions": (2,), "opacity_logits": (), "velocities": (2,)}
    gaussians = SimpleNamespace(**{name: torch.randn(2, count, *size).double() for name, size in names.items()})
    expected, joined = anchor(gaussians), anchor(gaussians, anchor.joined())
    torch.testing.assert_close(joined, expected)
    pull, parameters = torch.randn_like(expected), list(anchor.parameters())
    wanted, found = (torch.autograd.grad((x * pull).sum(), parameters) for x in (expected, joined))
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other)
    anchor.merge_for_inference()
    torch.testing.assert_close(anchor(gaussians), expected)


MODELS = {
    "phase 1": ("phase=phase1",),
    "phase 2": ("phase=phase2",),
    "radar only": ("phase=phase2", "model.kggi=null", "model.ocsf=null", "model.dptf.gaussian_path=null"),
    "wide gates, attributes": ("phase=phase1", "model.ocsf.gate_kernel_size=3", "model.head.attributes=learned"),
    "other neck": ("phase=phase1", "backbone.neck=secondfpn16"),
    "dense": ("phase=phase2", "model=dense_bev"),
    "crt_fusion": (
        "phase=phase2", "model=crt_fusion", "model.head.score_threshold=0.015",
        "model.temporal.occupancy_threshold=0.01",
    ),
    "hydra": ("phase=phase2", "model=hydra"),
    "radargnn": ("phase=phase1", "model=radargnn", "model.head.score_threshold=0.005"),
    "sparc": ("phase=phase2", "model=sparc"),
    "petr": ("phase=phase2", "model=petr"),
    "far3d": ("phase=phase2", "model=far3d", "model.queries.score_threshold=0.01"),
    "rctrans": ("phase=phase2", "model=rctrans"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_no_norm_is_left_behind_a_layer_and_the_trained_model_is_untouched(trained, name):
    model = trained(*MODELS[name]).model
    before = {key: value.clone() for key, value in model.state_dict().items()}
    prepared = prepare_for_inference(model)
    left = {id(x) for x in prepared.modules() if isinstance(x, nn.modules.batchnorm._BatchNorm)}
    before_a_union = [x for x in prepared.modules() if isinstance(x, SparseFusion)]
    assert left == {id(norm) for fusion in before_a_union for norm in (fusion.norm_gaussian, fusion.norm_radar)}
    assert not any(parameter.requires_grad for parameter in prepared.parameters()) and not prepared.training
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())
    assert model.prepared_for is None and all(parameter.requires_grad for parameter in model.parameters())
    with pytest.raises(ValueError, match="prepared for inference already"):
        prepare_for_inference(prepared)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_a_stream_gives_the_same_detections(trained, name):
    """Choices among near-equals (the farthest Gaussian, a cell at the threshold) may fall otherwise by rounding."""
    detector = trained(*MODELS[name])
    plain, fast = pair(detector)
    shares, exact = [], 0
    for k in range(FRAMES if plain.model.config.memory_frames else 3):
        frame = make_frame(detector, 0.5 * k, seed=k)
        wanted, found = plain.step(frame), fast.step(frame)
        assert len(wanted) > 20 and abs(len(found) - len(wanted)) <= 0.02 * len(wanted)
        gaps = distance(found, wanted)
        shares.append(float((gaps < 0.02).float().mean()))
        exact += bool((gaps < 1e-3).all())
        if plain.memory is not None:
            assert len(plain.memory.frames) == len(fast.memory.frames)
    assert min(shares) > 0.97 and exact >= 2, (shares, exact)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["phase 1", "phase 2", "dense"])
def test_bf16_is_no_further_from_float32_than_the_plain_path_in_bf16(trained, name):
    detector = trained(*MODELS[name])
    (plain, fast), (exact, _) = pair(detector, "bf16-mixed"), pair(detector)
    near = torch.zeros(2)
    for k in range(6 if plain.model.config.memory_frames else 2):
        frame = make_frame(detector, 0.5 * k, seed=k)
        wanted = exact.step(frame)
        found = [one.step(frame) for one in (plain, fast)]
        near += torch.stack([(distance(boxes, wanted) < 0.5).float().mean() for boxes in found])
        assert abs(len(found[0]) - len(found[1])) < 0.1 * len(wanted)
        for one in (plain, fast):
            one.memory = exact.memory  # else the rounding of earlier frames would hide that of this one
    assert near[1] > 0.9 * near[0] and near[0] > 0, near
    for value in (found[1].scores, found[1].velocities):
        assert (value != value.bfloat16()).any()  # heads do not round their outputs
    assert any(value.dtype == torch.bfloat16 for value in fast.model.parameters())


def test_what_is_remembered_is_the_same(trained):
    """One step from the same memory, which leaves rounding no time to grow."""
    detector = trained(*MODELS["phase 2"])
    plain, fast = pair(detector)
    for k in range(4):
        frame = make_frame(detector, 0.5 * k, seed=k)
        plain.step(frame)
        fast.step(frame)
        mine, wanted = fast.memory.frames[0], plain.memory.frames[0]
        places = (mine.cells.xy[:, None] == wanted.cells.xy).all(2)  # in the order of scores, which rounding may swap
        assert len(mine.cells.rows) == len(wanted.cells.rows) > 100 and places.sum() > 0.99 * len(mine.cells.rows)
        here, there = places.nonzero(as_tuple=True)
        torch.testing.assert_close(mine.cells.features[here], wanted.cells.features[there], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(mine.cells.velocities[here], wanted.cells.velocities[there], rtol=1e-3, atol=1e-2)
        assert torch.equal(mine.gaussians.valid, wanted.gaussians.valid)
        torch.testing.assert_close(mine.gaussians.means, wanted.gaussians.means, rtol=0, atol=1e-2)
        fast.memory = plain.memory


def sizes_seen(detector, frames):
    """Number of Gaussians that the encoder got, and how often images were encoded, frame by frame."""
    sizes, encoded = [], []
    hooks = [
        detector.model.ocsf.encoder.register_forward_pre_hook(lambda _, args: sizes.append(args[0].means.shape[:2])),
        detector.model.image_encoder.register_forward_hook(lambda *_: encoded.append(len(sizes))),
    ]
    for frame in frames:
        detector.step(frame)
    for hook in hooks:
        hook.remove()
    return sizes, encoded


@pytest.mark.slow
def test_the_number_of_gaussians_never_changes_and_images_are_encoded_once(trained):
    detector = trained(*MODELS["phase 2"])
    plain, fast = pair(detector)
    frames = [make_frame(detector, 0.5 * k, seed=k) for k in range(6)]
    frames += [make_frame(detector, 20.0, seed=6), make_frame(detector, 20.5, seed=7, x_m=0.0)]  # too old, jumped
    config = detector.model.config
    capacity = sum(config.kggi.counts.values()) + config.dptf.gaussian_path.num_history_gaussians
    sizes, encoded = sizes_seen(fast, frames)
    assert set(sizes) == {(1, capacity)} and encoded == list(range(len(frames)))
    sizes, encoded = sizes_seen(plain, frames)
    assert len(set(sizes)) > 2 and encoded == list(range(len(frames)))


def test_padding_of_the_history_changes_nothing(trained):
    detector = trained(*MODELS["phase 2"])
    _, padded = pair(detector)
    _, grown = pair(detector)
    grown.model.dptf.gaussian_path.fixed_capacity = False
    for k in range(3):
        frame = make_frame(detector, 0.5 * k, seed=k)
        found, output = padded.run(frame)
        wanted, _ = grown.run(frame)
        assert output.dptf.history.means.isfinite().all()
        assert k or not output.dptf.history.valid.any()  # the first frame: nothing but padding
        assert float(distance(found, wanted).max()) < 2e-2
        padded.memory = grown.memory


def test_decoding_at_top_cells_equals_codes_of_every_cell(trained):
    detector = trained(*MODELS["phase 1"])
    for one in pair(detector):
        found, output = one.run(make_frame(detector, 0.0))
        head, features = one.model.head, output.head.bev.features
        with torch.inference_mode():
            every = torch.stack([branches(features) for branches in head.regressions], dim=1)
            (wanted,) = head.decode(replace(output.head, codes=every))
        for field in fields(Boxes3D):
            value = getattr(found, field.name)
            assert value is None or torch.allclose(value, getattr(wanted, field.name), rtol=1e-4, atol=1e-4), field.name


@pytest.mark.slow
def test_the_lean_variant_keeps_the_cells(trained):
    lean = trained("phase=phase1", "model.radar_encoder.conv_out=subm")
    full = trained("phase=phase1", "model.radar_encoder.conv_out=sparse")
    frame = make_frame(lean, 0.0)
    outputs = [StreamingDetector(x.model, x.grid, x.settings).run(frame)[1] for x in (lean, full)]
    assert 0 < len(outputs[0].radar_bev) < len(outputs[1].radar_bev)


def test_switches_that_do_not_go_together(trained):
    parts = trained(*MODELS["phase 1"])
    with pytest.raises(ConfigError, match="plain=True"):
        StreamingDetector(parts.model, parts.grid, parts.settings, plain=True, compiled=True)


def test_on_a_cpu_a_graph_is_the_network_itself(trained):
    detector = trained(*MODELS["phase 1"])
    plain, fast = pair(detector, cuda_graph=True)
    assert isinstance(fast.model.image_encoder.backbone, GraphReplay)
    frame = make_frame(detector, 0.0)
    assert float(distance(fast.step(frame), plain.step(frame)).max()) < 1e-3


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_a_cuda_graph_gives_the_networks_own_maps(trained, precision):
    encoder = prepare_for_inference(trained(*MODELS["phase 1"]).model.cuda(), precision).image_encoder
    network = ImageNetwork(encoder.backbone, encoder.neck)
    replay = GraphReplay(network)
    kept = []
    with torch.inference_mode(), computing(precision, torch.device("cuda")):
        for seed in range(3):
            generator = torch.Generator("cuda").manual_seed(seed)
            x = torch.randn(4, 3, 96, 320, device="cuda", generator=generator)
            kept.append((replay(x), network(x)))
    for found, wanted in kept:  # later calls leave earlier results alone
        for mine, theirs in zip(found, wanted, strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-2, atol=1e-2)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None and shutil.which("clang++") is None, reason="no C++ compiler")
def test_compiled_parts_give_the_same_boxes_and_are_compiled_once(trained):
    from torch._dynamo.utils import counters

    detector = trained(*MODELS["phase 2"])
    plain, fast = pair(detector, compiled=True)
    counters.clear()
    for k in range(3):
        frame = make_frame(detector, 0.5 * k, seed=k)
        gaps = distance(fast.step(frame), plain.step(frame))
        assert float((gaps < 0.02).float().mean()) > 0.97
    assert counters["frames"]["total"] == counters["frames"]["ok"] == 6 and not counters["graph_break"]
