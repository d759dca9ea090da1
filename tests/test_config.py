"""Every shipped configuration composes; every mistake is named."""

import json
import math
import os
import re
import signal

import pytest

from src.config import CONF, compose_config, refuse_options_of_others, restore_config
from src.errors import CheckpointError, ConfigError
from src.reliability.command import run_command
from src.training.identity import LEGACY_DEFAULTS, run_identity, without_keys
from src.training.optim import cycle_value
from tests.running import command

TERMS = [
    "heatmap", "box", "keypoint", "depth", "radar_objectness", "occupancy_focal", "occupancy_dice", "cell_focal",
    "cell_dice", "cell_lovasz", "cell_velocity", "gaussian_velocity",
]  # fmt: skip
"""Of Horizon3D's loss."""
SCALES = sorted(p.stem for p in (CONF / "scale").glob("*.yaml"))


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("radar_only", [False, True])
def test_every_scale_composes(scale, radar_only):
    overrides = [f"scale={scale}", "data.root=x"] + (["model.kggi=null", "model.ocsf=null"] if radar_only else [])
    config, tree = compose_config(overrides)
    assert config.scale == tree["scale"] == scale
    assert config.model.sensors == (("radar",) if radar_only else ("camera", "radar"))
    # The range and the cell are those of the paper at every scale.
    assert config.grid.cells == [384, 384] and config.grid.cell_m == 0.8


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
def test_phase_2_composes_at_every_scale(scale):
    """With every part of the memory on; only counts shrink, and phase 1 drops the part altogether."""
    config, tree = compose_config([f"scale={scale}", "data.root=x", "phase=phase2"])
    phase, dptf = config.phase, config.model.dptf
    assert (phase.name, phase.temporal, phase.init_from, phase.train_missing) == ("phase2", True, "phase1", True)
    assert dptf.bev_path.velocity_compensation and dptf.gaussian_path.velocity_compensation
    assert dptf.gaussian_path.sampling.value == "farthest_point" and dptf.max_age_s == 6.0
    assert config.model.channels % dptf.gaussian_path.self_attention.num_heads == 0
    assert config.data.groups_per_scene == (1 if scale == "mini" else 2)
    _, single = compose_config([f"scale={scale}", "data.root=x", "phase=phase1"])
    assert single["model"]["dptf"] is None and tree["model"]["dptf"] is not None


@pytest.mark.slow
def test_both_phases_of_mini_lie_within_one_cycle_of_the_learning_rate():
    first, second, further = (compose_config([f"phase={name}"])[0] for name in ("phase1", "phase2", "phase1_further"))
    assert first.optim.lr * first.optim.final_lr_ratio == pytest.approx(second.optim.lr * second.optim.peak_lr_ratio)
    assert second.optim.rise_fraction == 0 and first.optim.rise_fraction * first.phase.epochs == pytest.approx(4, 1e-3)
    assert first.optim.final_lr_ratio == cycle_value(6, first.phase.epochs + second.phase.epochs, 0.4, 1.0, 10.0, 0.0)
    assert (further.optim, further.phase.epochs) == (second.optim, second.phase.epochs)
    assert further.phase.options == second.phase.options and not further.phase.temporal


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
def test_all_phases_of_lrs4fusion_give_the_network_the_same_speeds(scale):
    own = ("model=lrs4fusion", f"scale={scale}", "data.root=x")
    phases = ("lrs_occupancy", "lrs_forecast", "lrs_detection")
    assert len({compose_config([*own, f"phase={name}"])[0].data.timeline.radial_speeds for name in phases}) == 1


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["lrs_occupancy", "lrs_forecast", "lrs_detection"])
def test_lrs4fusion_at_full_size_reads_one_cloud_a_frame_and_never_turns_its_region_round(phase):
    """roi_lrs reaches farther ahead than back. At mini it does not, and boxes are learned from flips of x as well."""
    config, mini = (
        compose_config(["model=lrs4fusion", f"phase={phase}", f"scale={scale}", "data.root=x"])[0]
        for scale in ("paper", "mini")
    )
    assert config.model.roi.upper_m[0] > -config.model.roi.lower_m[0] and config.data.num_lidar_sweeps == 1
    boxes = phase == "lrs_detection"
    assert config.data.augmentation.bev.flip_probability == ([0.0, 0.5] if boxes else 0.0)
    assert mini.data.augmentation.bev.flip_probability == (0.5 if boxes else 0.0) and mini.data.num_lidar_sweeps == 1


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
@pytest.mark.parametrize("name", ["dense_bev", "crt_fusion", "hydra", "sparc", "petr", "far3d", "rctrans"])
def test_other_detectors_without_lidar_compose_at_every_scale(scale, phase, name):
    """At the same range and cell; phase 1 drops what its settings name as temporal."""
    config, tree = compose_config([f"scale={scale}", "data.root=x", f"model={name}", f"phase={phase}"])
    model = config.model
    assert model.name == tree["model"]["name"] == name and config.grid.cells == [384, 384]
    assert (model.temporal is None) == (tree["model"]["temporal"] is None) == (phase == "phase1")
    assert (model.memory_frames > 0) == (model.memory_max_age_s == 6.0) == (phase == "phase2")
    parts = {"sparc": "queries", "far3d": "queries", "petr": "position", "rctrans": "position"}
    lifted = getattr(model, parts.get(name, "view_transform"))
    assert lifted.num_depth_bins in ((16, 32, 64) if parts.get(name) == "position" else (16, 80))
    assert lifted.depth_range == (1.0, 160.0)


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize(
    ("overrides", "off"),
    [
        (["model.dptf.gaussian_path=null"], {"gaussian_path"}),  # Table 5
        (["model.dptf.bev_path=null"], {"bev_path"}),
        (["model.dptf.bev_path.velocity_compensation=false"], set()),  # Table 6
        (["model.dptf.gaussian_path.velocity_compensation=false", "model.dptf.bev_path=null"], {"bev_path"}),
        (["model.dptf.gaussian_path.sampling=top_opacity"], set()),  # Table 7
        (["model.dptf.gaussian_path.sampling=random", "model.dptf.bev_path=null"], {"bev_path"}),
        (["model.dptf.gaussian_path.self_attention=null"], {"self_attention"}),  # Table 13
        (["model.kggi.initialization=random"], set()),  # Table 2
        (["model.kggi=null", "model.ocsf=null", "model.dptf.gaussian_path=null"], {"gaussian_path"}),
        (["model.dptf.max_age_s=0.55"], set()),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, list) else "",
)
def test_memory_is_switched_by_configuration_values(scale, overrides, off):
    config, _ = compose_config([f"scale={scale}", "data.root=x", "phase=phase2", *overrides])
    dptf = config.model.dptf
    parts = {"bev_path": dptf.bev_path, "gaussian_path": dptf.gaussian_path}
    parts["self_attention"] = dptf.gaussian_path and dptf.gaussian_path.self_attention
    off = off | ({"self_attention"} if "gaussian_path" in off else set())
    assert {name for name, part in parts.items() if part is None} == off


CHOICES = [(group, path.stem) for group in ("backbone", "data", "trainer", "logger")
           for path in sorted((CONF / group).glob("*.yaml"))]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("group", "name"), CHOICES)
def test_every_choice_composes(group, name):
    compose_config([f"{group}={name}", "data.root=x"])


def test_there_are_choices():
    assert {group for group, _ in CHOICES} == {"backbone", "data", "trainer", "logger"} and len(CHOICES) > 8


def test_paper_values():
    """The bold values of the method 16."""
    config, _ = compose_config(["scale=paper", "data.root=x"])
    model = config.model
    assert config.backbone.name.value == "resnet50" and config.backbone.image_size_px == [256, 864]
    assert (config.data.batch_size, config.data.num_sweeps, config.phase.epochs) == (8, 10, 24)
    assert (config.optim.lr, config.optim.weight_decay, config.optim.clip_norm) == (1e-4, 1e-2, 35.0)
    kggi, ocsf = model.kggi, model.ocsf
    assert (kggi.num_radar_keypoints, kggi.num_camera_keypoints, kggi.num_random_keypoints) == (1024, 256, 256)
    assert (ocsf.num_layers, ocsf.num_learnable_points, ocsf.margin_m, ocsf.occupancy_threshold) == (2, 6, 4.8, 0.1)
    assert (model.loss.kggi_weight, model.loss.ocsf_weight) == (1.0, 5.0)
    assert config.data.augmentation.image.resize == [-0.06, 0.11]
    assert config.data.augmentation.bev.rotation_rad == 0.3925
    vovnet, _ = compose_config(["scale=paper", "data.root=x", "backbone=vovnet99"])
    assert vovnet.backbone.image_size_px == [640, 960] and vovnet.backbone.lr_multiplier == 0.1


# Specification 16: keys and their values at full size.
FULL_SIZE = {
    "grid": {"cells": [384, 384], "cell_m": 0.8, "centre_m": [0.0, 0.0], "z_range_m": [-3.0, 5.0]},
    "backbone": {
        "name": "resnet50", "image_size_px": [256, 864], "weights": None, "lr_multiplier": 1.0, "neck": "fpn",
        "trim_padding": False,
    },
    "model": {"channels": 128, "neck_channels": []},
    "model.radar_encoder": {
        "voxel_size_m": [0.1, 0.1, 0.2], "stage_channels": [16, 32, 64, 128, 128, 128], "max_voxels": 60000,
        "conv_out": "sparse", "height_tolerance_deg": 0.0, "pruning_ratio": 0.0,
    },
    "model.kggi": {
        "initialization": "both", "num_radar_keypoints": 1024, "num_camera_keypoints": 256,
        "num_random_keypoints": 256, "num_depth_bins": 80, "depth_range_m": [1.0, 160.0], "depth_target": "box",
        "num_radar_peaks": 0, "keypoint_nms_cells": None, "property_head": True, "source_embedding_std": 1.0,
    },
    "model.ocsf": {
        "num_layers": 2, "num_learnable_points": 6, "margin_m": 4.8, "occupancy_threshold": 0.1,
        "max_occupied_cells": 32768, "scale_range_m": [0.2, 3.2], "max_mean_shift_m": 4.0, "max_speed_mps": 60.0,
        "velocity_unit_mps": 10.0, "support_sigmas": 3.0, "cross_attention": "parallel",
        "refine_from": "self_encoding", "gate_kernel_size": 1,
        "identity_start": False,
    },
    "model.doppler": {"gaussians": True, "cells": False, "boxes": True, "in_losses": False, "along_heading": True},
    "model.head": {"nms": "maxpool", "score_threshold": 0.1, "max_boxes": 500, "attributes": "rule"},
    "model.loss": {
        "kggi_weight": 1.0, "ocsf_weight": 5.0, "heatmap_weight": 1.0, "box_weight": 0.25, "keypoint_weight": 1.0,
        "depth_weight": 1.0, "radar_objectness_weight": 1.0, "occupancy_focal_weight": 1.0,
        "occupancy_dice_weight": 1.0, "gaussian_velocity_weight": 0.25, "gaussian_velocity_in_phase1": True,
        "dptf_weight": 1.0, "cell_focal_weight": 1.0, "cell_dice_weight": 1.0, "cell_lovasz_weight": 1.0,
        "cell_velocity_weight": 0.25, "velocity_groups": "boxes",
    },
    "phase": {
        "epochs": 24, "module": "TrainingModule", "task": "detection", "monitor": "val/mAP", "init_from": None,
        "train_missing": True, "frozen_statistics": False, "long_range": None,
    },
    "phase.options": {"velocity_code_weight": 0.2},
    "optim": {
        "lr": 1e-4, "weight_decay": 0.01, "clip_norm": 35.0, "peak_lr_ratio": 10.0, "final_lr_ratio": 1e-4,
        "rise_fraction": 0.4, "betas": [0.95, 0.99], "cycled_beta1": [0.95, 0.85], "ema_decay": None,
    },
    "data": {
        "train_split": "train", "train_scenes": None, "split": "val", "batch_size": 8, "num_sweeps": 10,
        "min_distance_m": 1.0, "propagate_points": False, "on_bad_file": "error", "test_resize_offset": 0.0,
        "groups_per_scene": 2, "stream_sets": 1, "past_frames": 0, "past_window_s": None,
        "sensor_dropout": 0.0, "num_lidar_sweeps": 5, "lidar_origins": False, "deskew_lidar": True,
        "timeline": None, "num_future_frames": 0,
    },
    "data.augmentation.image": {"resize": [-0.06, 0.11], "rotation_deg": 5.4, "flip_probability": 0.5},
    "data.augmentation.bev": {"scale": [0.95, 1.05], "rotation_rad": 0.3925, "flip_probability": 0.5},
    "paths": {"outputs": "outputs", "reports": "reports"},
    "": {
        "precision": "bf16-mixed", "seed": 0, "resume": "auto", "checkpoint": None, "predictions": None, "out": None,
        "preview": False, "compare": False, "suite": "model",
    },
}  # fmt: skip


# The same for what phase 2 adds or changes.
FULL_SIZE_PHASE_2 = {
    "phase": {
        "epochs": 24, "module": "TemporalModule", "task": "detection", "monitor": "val/mAP", "init_from": "phase1",
        "train_missing": True, "temporal": True,
    },
    "phase.options": {"velocity_code_weight": 1.0},
    "model.doppler": {"gaussians": True, "cells": True, "boxes": True, "in_losses": False, "along_heading": True},
    "model.dptf": {"max_age_s": 6.0, "min_speed_mps": 1.0},
    "model.dptf.bev_path": {
        "num_frames": 8, "memory_threshold": 0.1, "max_cells_per_frame": 4096, "velocity_compensation": True,
        "spatial_dilation": False,
    },
    "model.dptf.gaussian_path": {
        "num_frames": 4, "gaussians_per_frame": 256, "min_contribution": 0.2, "sampling": "farthest_point",
        "velocity_from": "gaussian", "velocity_compensation": True, "self_attention": {"num_heads": 8},
    },
}  # fmt: skip


@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_full_size_values_are_those_of_the_specification(phase):
    config, tree = compose_config(["scale=paper", "data.root=x", f"phase={phase}"])
    wanted = FULL_SIZE if phase == "phase1" else FULL_SIZE | FULL_SIZE_PHASE_2
    if phase == "phase2":
        path = config.model.dptf.gaussian_path
        assert path.num_history_gaussians == 1024  # K_hist; 2560 Gaussians in all
        assert path.num_history_gaussians + sum(config.model.kggi.counts.values()) == 2560
    for group, values in wanted.items():
        node = tree
        for name in group.split(".") if group else []:
            node = node[name]
        assert {name: node.get(name, "no such key") for name in values} == values, group


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["phase=phase3"], "phase3.*phase1"),
        (["scale=huge"], "huge.*mini"),
        (["model.ocsf.margn_m=4.8"], "margn_m.*did you mean model.ocsf.margin_m"),
        (["+model.typo=1"], "model.typo is not a configuration key"),
        (["+model.ocsf.margn_m=1"], "did you mean margin_m"),
        (["model.ocsf.margin_m=nan"], "model.ocsf.margin_m must be a finite number"),
        (["model.ocsf.margin_m=-1"], "margin_m"),
        (["model.ocsf.margin_m=wide"], "margin_m"),
        (["optim.lr=-1"], "optim.lr must be above 0"),
        (["phase.monitor=val/xyz"], "phase.monitor=val/xyz: must be one of val/mAP, val/NDS"),
        (["phase.monitor="], "phase.monitor=: must be one of"),
        (["optim.betas=[]"], "optim.betas"),
        (["optim.betas=[0.9,0.99]"], r"optim.betas=\[0.9, 0.99\] begins with another beta1.*cycled_beta1=null"),
        (["trainer.devices=0"], "trainer.devices"),
        (["trainer.devices=3"], "data.batch_size=2.*trainer.devices=3"),
        (["precision=16"], "precision"),
        (["resume=maybe"], "resume"),
        (["--help"], "key=value"),
        (["model.kggi=null"], "model.kggi.*model.ocsf|model.ocsf.*model.kggi"),
        (["data.on_bad_file=ignore"], "on_bad_file"),
        (
            ["model=centerpoint", "model.loss.heatmap_weight=null", "model.loss.box_weight=null"],
            "heatmap_weight, box_weight are all null.*give one",
        ),
        (
            [f"model.loss.{name}_weight=null" for name in TERMS],
            "heatmap_weight, .*gaussian_velocity_weight are all null.*give one",
        ),
        (["data.world.num_train_scenes=-1"], "num_train_scenes"),
        (["scale=paper"], "data.root has no value"),
        (["phase.epochs=0"], "phase.epochs"),
        (["foo=1"], "^(?!.*[+]foo).*foo"),  # Hydra's advice, +foo=1, would be refused as well
        (["model=null"], "model=null.*one of its names"),
        (["logger.wandb.project=x"], "logger=wandb"),
        (["~model.kggi"], "model.kggi=null"),
        (["checkpoint=a=b.ckpt"], "quoted"),
        (["data.root=~/x"], "HOME"),
        (["seed=${nothing}"], "nothing"),
        (["seed=4294967296"], "seed.*4294967296"),
        (["model.name=other"], "model.name.*horizon3d"),
        (["model=dense_bev", "model.kggi=null"], "kggi"),
        (["model=dense_bev", "model.fused_channels=8"], "model.fused_channels=8.*at least 16"),
        (["model=dense_bev", "model.loss.depth_weight=-1"], "model.loss.depth_weight=-1"),
        (["model=dense_bev", "model.view_transform.image_stride_px=0"], "image_stride_px=0"),
        (["model=dense_bev", "phase=phase2", "model.temporal.num_frames=0"], "num_frames=0.*model.temporal=null"),
        (["model=crt_fusion", "phase=phase2", "model.temporal.occupancy_threshold=1"], "occupancy_threshold=1"),
        (["model=hydra", "model.fused_channels=18"], "model.fused_channels=18.*multiple of 4"),
        (["model=sparc", "phase=phase2", "model.temporal.queries_per_frame=0"], "queries_per_frame=0"),
        (["model=petr", "model.num_queries=0"], "model.num_queries=0"),
        (["phase=phase2", "phase.name=phase1"], "phase.name=phase1.*phase=\\.\\.\\."),
        (["phase.options.velocity_code_weight=-1"], "velocity_code_weight"),
        (["model=lrs4fusion"], "phase=phase1 is no phase of model=lrs4fusion; use phase=lrs_detection or"),
        (["phase=lrs_forecast"], "phase=lrs_forecast is no phase of model=horizon3d; use phase=phase1 or"),
        (["phase.options.velocity_code_weight=abc"], "phase.options.velocity_code_weight='abc': .*number"),
        (["phase.options.velocity_code_weight=null"], "phase.options.velocity_code_weight=None: .*number"),
        (["optim.final_lr_ratio=-1"], "final_lr_ratio"),
        (["trainer.accelerator=cuda9"], "accelerator.*gpu"),
        (["trainer.num_pictures=-1"], "num_pictures"),
        (["paths.outputs="], "paths.outputs is empty"),
        (["checkpoint="], "checkpoint is empty"),
        (["data.root="], "data.root is empty"),
        (["data.world.returns_density=1e9"], "returns_density"),
        (["phase=phase2", "model.dptf.bev_path=null", "model.dptf.gaussian_path=null"], "model.dptf=null"),
        (["phase=phase2", "model.kggi=null", "model.ocsf=null"], "model.dptf.gaussian_path=null"),
        (["phase=phase2", "model.dptf.max_age_s=-1"], "max_age_s=-1.*positive"),
        (["phase=phase2", "model.dptf.gaussian_path.sampling=best"], "sampling.*farthest_point"),
        (["phase=phase2", "model.dptf.gaussian_path.num_frames=0"], "num_frames=0.*gaussian_path=null"),
        (["phase=phase2", "model.dptf.gaussian_path.self_attention.num_heads=0"], "num_heads=0.*self_attention=null"),
        (["phase=phase2", "model.dptf.gaussian_path.self_attention.num_heads=3"], "num_heads=3.*model.channels=64"),
        (["model.neck_channels=[64,0]"], r"model.neck_channels=\[64, 0\]: must list positive widths"),
        (["phase=phase2", "model.dptf.gaussian_path.selfattention=null"], "did you mean .*self_attention"),
        (["data.groups_per_scene=0"], "groups_per_scene"),
        (["data.stream_sets=0"], "stream_sets"),
        (["data.past_frames=-1"], "past_frames"),
        (["phase.init_from="], "phase.init_from is empty"),
        (["scale=[debug,mini]"], r"scale=\[debug,mini\]: scale is one file of conf/scale/"),
        (["model=[]"], r"model=\[\]: model is one file of conf/model/"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        compose_config(overrides)


def test_relations_with_the_grid_are_named():
    from src.assembly import build_model

    config, _ = compose_config(["scale=debug", "grid.cells=[383,384]"])
    with pytest.raises(ConfigError, match=r"grid.cells=.*383.*multiple of"):
        build_model(config)
    config, _ = compose_config(["scale=debug", "grid.cells=[8,8]", "model.kggi.num_radar_keypoints=100"])
    with pytest.raises(ConfigError, match="num_radar_keypoints"):
        build_model(config)


def test_an_option_of_the_phase_is_one_setting_however_it_is_written():
    whole, point = (
        compose_config(["scale=debug", f"phase.options.velocity_code_weight={one}"])[1] for one in ("1", "1.0")
    )
    assert whole == point and isinstance(whole["phase"]["options"]["velocity_code_weight"], float)


def test_a_choice_below_a_group_replaces_its_part_of_a_stored_configuration():
    overrides = ["scale=paper", "data=synthetic", "data.world.lidar=true", "model=lrs4fusion", "phase=lrs_occupancy"]
    _, tree = compose_config(overrides)
    found = restore_config(tree, ["model=lrs4fusion", "model/roi=roi_official"]).model.roi
    assert found == compose_config([*overrides, "model/roi=roi_official"])[0].model.roi
    assert found != restore_config(tree, []).model.roi


def test_whole_numbers_in_a_nested_list_are_told_how_to_be_written():
    given = ["scale=debug", "model=lrs4fusion", "phase=lrs_detection", "phase.long_range.ranges_m=[[0,50]]"]
    with pytest.raises(ConfigError, match="with a point, as 50.0$"):
        compose_config(given)


@pytest.mark.slow
def test_a_stored_phase_2_comes_back_with_its_memory():
    """The command's own default phase drops the memory; the checkpoint's phase counts."""
    _, tree = compose_config(["scale=debug", "phase=phase2", "model.dptf.gaussian_path.gaussians_per_frame=3"])
    config = restore_config(tree, ["model.dptf.max_age_s=0.55", "data.root=/elsewhere"])
    assert config.phase.temporal and config.model.dptf.max_age_s == 0.55 and config.data.root == "/elsewhere"
    assert config.model.dptf.gaussian_path.gaussians_per_frame == 3 and config.model.dptf.bev_path.num_frames == 2
    assert restore_config(tree, []).model.dptf.max_age_s == 6.0
    both = restore_config(tree, ["logger.wandb.project=mine", "logger=wandb"])  # the part first, however it is typed
    assert both.logger.wandb.project == "mine"
    _, single = compose_config(["scale=debug"])
    with pytest.raises(ConfigError, match="model.dptf.max_age_s: the checkpoint has no model.dptf"):
        restore_config(single, ["model.dptf.max_age_s=0.55"])


def test_a_stored_dense_baseline_comes_back_as_such():
    """Also where the command line says nothing of the model, whose default is another."""
    _, tree = compose_config(["scale=debug", "phase=phase2", "model=dense_bev", "model.temporal.num_frames=3"])
    for named in ([], ["model=dense_bev"]):  # commands compose their line by itself, and then need to be told
        config = restore_config(tree, [*named, "model.temporal.max_age_s=0.55", "data.root=/elsewhere"])
        assert config.model.name == "dense_bev" and config.model.temporal.num_frames == 3
        assert config.model.memory_max_age_s == 0.55 and config.data.root == "/elsewhere"
    with pytest.raises(ConfigError, match="model=horizon3d: the checkpoint is of model=dense_bev"):
        restore_config(tree, ["model=horizon3d"])


@pytest.mark.slow
def test_a_stored_configuration_comes_back_with_the_command_lines_changes():
    _, tree = compose_config(["scale=debug", "model.ocsf.margin_m=1.6", "seed=4"])
    config = restore_config(tree, ["data.split=train", "data.root=/elsewhere"])
    assert config.model.ocsf.margin_m == 1.6 and config.seed == 4 and config.scale == "debug"
    assert config.data.split == "train" and config.data.root == "/elsewhere"
    whole = restore_config(tree, ["data=truckscenes", "data.root=/real"])
    assert whole.data.world is None and whole.data.version == "v1.2-trainval"


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [{"model": {"name": "other"}}, {"phase": {"name": "x"}}, {"phase": None}, {"unknown": 1}, {"seed": math.nan}],
)
def test_a_stored_configuration_of_other_code_is_refused(change):
    _, tree = compose_config(["scale=debug"])
    with pytest.raises(CheckpointError):
        restore_config(tree | change, [])


def test_another_scale_than_the_checkpoints_is_refused():
    _, tree = compose_config(["scale=debug"])
    with pytest.raises(ConfigError, match="scale=mini.*scale=debug"):
        restore_config(tree, ["scale=mini"])


def test_another_data_choice_is_taken_at_the_checkpoints_scale():
    _, tree = compose_config(["scale=paper", "data.root=/real"])
    config = restore_config(tree, ["data=truckscenes", "data.root=/elsewhere"])
    assert config.data.num_sweeps == 10 and not config.data.propagate_points


def test_the_lidar_timeline_composes_and_a_checkpoint_older_than_it_has_none():
    config, tree = compose_config(["scale=debug", "data.root=x", "+data/timeline=lidar", "data.num_future_frames=2"])
    assert config.data.timeline.interval_s == 0.2 and config.data.timeline.last_step == 15
    assert restore_config(tree, []).data.timeline == config.data.timeline
    _, tree = compose_config(["scale=debug", "data.root=x"])
    del tree["data"]["timeline"]
    assert restore_config(tree, []).data.timeline is None


def test_a_second_score_of_detections_composes_and_an_older_checkpoint_has_none():
    config, tree = compose_config(["scale=debug", "model=lrs4fusion", "phase=lrs_detection"])
    assert config.phase.long_range.thresholds_m == [6.0] and config.phase.long_range.range_names[-1] == "150-250"
    assert restore_config(tree, []).phase.long_range == config.phase.long_range
    with pytest.raises(ConfigError, match="long_range scores detections, but phase.task=occupancy"):
        compose_config(["scale=debug", "model=lrs4fusion", "phase=lrs_detection", "phase.task=occupancy",
                        "phase.monitor=val/iou"])  # fmt: skip


@pytest.mark.parametrize(("key", "before"), LEGACY_DEFAULTS.items())
def test_what_was_made_before_there_was_a_key_is_what_it_was(key, before):
    world_model = ["model=lrs4fusion", "phase=lrs_forecast"]
    owners = dict.fromkeys(
        ("model.loss.ray_range_power", "model.measured_motion", "model.neck.finest_scale"), world_model
    )
    own = (owners | {"model.decoder.num_radar_cells": ["model=rctrans"]}).get(key, ["phase=phase2"])
    config, tree = compose_config(["scale=debug", *own, f"{key}={json.dumps(before)}"])
    older = without_keys(tree, [key])
    assert older != tree and run_identity(older) == run_identity(tree)
    assert restore_config(older, []) == config


@pytest.mark.parametrize("scale", SCALES)
def test_every_scale_reads_recorded_data(scale):
    config, _ = compose_config([f"scale={scale}", "data=truckscenes", "data.root=x"])
    assert config.data.world is None and config.data.root == "x"


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (OSError(28, "No space left on device", "/x/metrics.csv"), 3, r"/x/metrics\.csv.*No space left.*MiB are free"),
        (PermissionError(13, "Permission denied", "/x/y"), 3, "/x/y.*Permission denied"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 9 bytes"), 1, "data.batch_size"),
        (ValueError("a bug"), 1, "defect of the program"),
        (KeyboardInterrupt(), 6, "same command"),
    ],
)
def test_a_command_ends_with_a_message_and_its_exit_code(monkeypatch, capsys, error, code, words):
    def main(_overrides):
        raise error

    assert exit_code_of(main, monkeypatch) == code
    text = capsys.readouterr().err
    assert re.search(words, text) and ("Traceback" in text) == (words == "defect of the program")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_that_a_library_turns_into_another_error_is_an_interruption(monkeypatch, capsys, number):
    """Matplotlib's compiled code makes "Invalid bounding box" of it; launchers send signals twice."""

    def main(_overrides):
        try:
            os.kill(os.getpid(), number)
        except KeyboardInterrupt:
            os.kill(os.getpid(), number)
            raise ValueError("Invalid bounding box") from None

    assert exit_code_of(main, monkeypatch) == 6
    text = capsys.readouterr().err
    assert "Interrupted (Invalid bounding box)" in text and "Traceback" not in text


def exit_code_of(main, monkeypatch):
    """What `run_command` ends with; the handlers of signals are put back."""
    monkeypatch.setattr("sys.argv", ["x"])
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        with pytest.raises(SystemExit) as ended:
            run_command(main)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return ended.value.code


@pytest.mark.slow
def test_exit_code_of_a_configuration_error():
    result = command("train", "phase=phase3", expect=3)
    assert "phase3" in result.stderr and "phase1" in result.stderr and "phase2" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("command", "option", "users"),
    [
        ("train", "checkpoint=a.ckpt", "evaluate or .*benchmark"),
        ("train", "out=x", "evaluate or .*world"),
        ("gallery", "out=x", "evaluate"),
        ("report", "scene=x", "predict"),
        ("evaluate", "preview=true", "world"),
        ("predict", "oracle=velocity", "evaluate"),
        ("train", "suite=ops", "benchmark"),
    ],
)
def test_an_option_that_a_command_would_ignore_is_refused(command, option, users):
    config, _ = compose_config(["scale=debug", option])
    with pytest.raises(ConfigError, match=rf"{option}: an option of python -m src.{users}.*; leave it out"):
        refuse_options_of_others(config, command)
    refuse_options_of_others(compose_config(["scale=debug"])[0], command)


def test_an_override_that_does_not_fit_a_checkpoint_is_named():
    _, tree = compose_config(["model=centerpoint", "scale=debug", "data.world.lidar=true"])
    with pytest.raises(CheckpointError, match="configuration with data.world.lidar=false does not fit .*reads LiDAR"):
        restore_config(tree, ["data.world.lidar=false"])
