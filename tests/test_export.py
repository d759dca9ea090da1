"""The exported image encoder: a file that gives the detector's own features, and what is refused."""

import json

import pytest
import torch

from src import export
from src.errors import CheckpointError, ConfigError
from src.streaming import StreamingDetector
from tests.untrained import write_checkpoint


@pytest.mark.slow
def test_the_file_gives_the_features_of_the_detector(tmp_path, capsys):
    path = write_checkpoint(tmp_path / "model.ckpt", "phase=phase2")
    out = tmp_path / "new" / "encoder.pt2"
    export.main([f"checkpoint={path}", f"out={out}"])
    assert "encoder.pt2" in capsys.readouterr().out
    extra = {export.DESCRIPTION: ""}
    program = torch.export.load(out, extra_files=extra).module()
    encoders = [StreamingDetector.load(path, plain=plain).model.image_encoder for plain in (True, False)]
    generator = torch.Generator().manual_seed(0)
    for frames in (1, 3):
        size = (frames, 4, 3, *encoders[0].image_size_px)
        images = torch.randint(0, 256, size, dtype=torch.uint8, generator=generator)
        with torch.no_grad():
            for encoder in encoders:
                for mine, exported in zip(encoder(images), program(images), strict=True):
                    torch.testing.assert_close(exported, mine, rtol=1e-4, atol=1e-4)
    about = json.loads(extra[export.DESCRIPTION])
    assert about["backbone"] == "small" and len(about["outputs"]) == len(encoders[0].strides)


@pytest.mark.slow
def test_without_a_name_it_is_named_by_the_checkpoint(tmp_path, monkeypatch):
    folder = tmp_path / "outputs" / "some-run" / "checkpoints"
    folder.mkdir(parents=True)
    path = write_checkpoint(folder / "last.ckpt", "phase=phase1")
    described = []

    def save(program, out, extra_files):
        described.append(extra_files)
        out.write(b"program")

    monkeypatch.setattr(torch.export, "save", save)
    export.main([f"checkpoint={path}", f"paths.outputs={tmp_path / 'outputs'}"])
    exports = tmp_path / "outputs" / "exports"
    assert (exports / "some-run-last.pt2").is_file()
    export.main([f"checkpoint={path}", f"paths.outputs={tmp_path / 'outputs'}", "backbone.image_size_px=[64,128]"])
    assert len(list(exports.glob("some-run-last-*.pt2"))) == 1
    assert json.loads(described[-1][export.DESCRIPTION])["input"] == "[B, 4, 3, 64, 128] uint8 RGB"


@pytest.mark.slow
def test_what_cannot_be_exported_is_refused_with_a_reason(tmp_path):
    good = write_checkpoint(tmp_path / "good.ckpt", "phase=phase1")
    blind = write_checkpoint(tmp_path / "radar.ckpt", "phase=phase1", "model.kggi=null", "model.ocsf=null")
    trimmed = write_checkpoint(tmp_path / "trimmed.ckpt", "phase=phase1", "backbone.trim_padding=true")
    out = f"out={tmp_path / 'a.pt2'}"
    with pytest.raises(ConfigError, match="give checkpoint=PATH"):
        export.main([out])
    with pytest.raises(CheckpointError, match="does not exist"):
        export.main([f"checkpoint={tmp_path / 'nothing.ckpt'}", out])
    with pytest.raises(ConfigError, match="uses no images"):
        export.main([f"checkpoint={blind}", out])
    with pytest.raises(ConfigError, match="trim_padding=true looks at each image"):
        export.main([f"checkpoint={trimmed}", out])
    for wrong in ("a.onnx", ""):
        with pytest.raises(ConfigError, match="must be a file that ends in .pt2"):
            export.main([f"checkpoint={good}", f"out={tmp_path / wrong}"])
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="out="):
        export.main([f"checkpoint={good}", f"out={tmp_path / 'file' / 'a.pt2'}"])
