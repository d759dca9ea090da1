"""Detection one frame at a time with memory, for frames of a data set or of one's own sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from src.assembly import restored_model
from src.config import Config, restore_config
from src.data.reader import ReaderSettings
from src.data.sensors import Camera, LidarSweep, RadarSweep, frame_from_sensors
from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.deploy.inference import prepare_for_inference
from src.models.deploy.static_parts import compile_static_parts, replay_image_encoder
from src.models.deploy.whole_frames import WholeFrames
from src.models.detector import Detector
from src.ops import backend
from src.ops.fixed_shapes import Capacities
from src.ops.precision import Precision, computing
from src.reliability.checkpoints import read_checkpoint
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CAMERAS


class StreamingDetector:
    """A trained detector of either phase that takes consecutive frames of one vehicle and remembers them.

    What a frame may use of the past is decided frame by frame, by its time and pose (method 6.4):

    - On the first frame, after `reset`, and on a frame that says so (`FrameBatch.starts`) nothing is remembered.
    - Frames older than `model.dptf.max_age_s` (other families: `model.temporal.max_age_s`) are not used, so a long gap
      is as a first frame.
    - Frames that are not in the past of the present one are forgotten. So a frame given again replaces itself, less
      what lay at the far end of a full memory, and a clock that jumps back continues from there; call `reset` when
      another recording begins.
    - A frame that brings its past along (`FrameBatch.past`) is detected with that alone, and is not remembered.
    - Frames from which the vehicle could not have come at 100 m/s are not used: the localisation has jumped.

    Any number of frames may be given; only the last few are kept. The memory lives here, as `memory`, never in the
    model; a detector for a second vehicle can share the model: `StreamingDetector(d.model, d.grid, d.settings)`.
    """

    def __init__(
        self,
        model: Detector,
        grid: BEVGrid,
        settings: ReaderSettings,
        device: torch.device | str | None = None,
        precision: str | None = None,
        plain: bool = False,
        compiled: bool = False,
        cuda_graph: bool = False,
        capacities: Capacities | None = None,
    ) -> None:
        """`model` is a trained one, of which a copy is prepared for inference, or that of another detector.

        `device` None is where the model is. `precision` (see `Precision`) None is float32, or what the model is
        prepared for. `plain` runs the model itself, in evaluation mode and as it was trained: slower, the same boxes up
        to rounding. `compiled` compiles the parts of fixed shape, which takes a minute at the first frames and pays on
        a GPU.

        `cuda_graph` makes `step` replay one CUDA graph, for a model that has a form of fixed shapes (Horizon3D); of
        others, and without Triton's kernels, the image encoder is one. On a CPU it changes nothing. A frame that
        exceeds a capacity of the fixed shapes is detected without them; `whole_frames` counts such frames. `capacities`
        are others than the model's own, and make `step` use fixed shapes on any device.

        Raises ConfigError for a device that is not there or switches that do not go together, ValueError for a model
        that is prepared for another precision.
        """
        self.device = next(model.parameters()).device if device is None else torch.device(device)
        if self.device.type == "cuda" and not torch.cuda.is_available():
            raise ConfigError(f"device={device}: torch sees no GPU on this machine; use device=cpu")
        if plain and (compiled or cuda_graph or capacities):
            raise ConfigError("plain=True runs the model as trained; the other switches need it prepared")
        prepared = model.prepared_for
        if prepared is not None and (plain or compiled or cuda_graph or capacities):
            raise ConfigError(
                "plain, compiled, cuda_graph and capacities are for a trained model; "
                "that of another detector runs as it does there"
            )
        if precision is None:
            precision = prepared or Precision.FULL
        if prepared is not None and prepared != precision:
            raise ValueError(f"the model is prepared for precision={prepared}, but {precision} was asked for")
        if prepared is None and not plain:
            model = prepare_for_inference(model, precision)
        self.model = model.to(self.device).eval()
        # What runs without Triton's kernels waits for counts, which a graph cannot hold.
        captured = cuda_graph and self.device.type == "cuda" and backend.chosen() == backend.TRITON
        form = self.model.fixed_form(capacities) if captured or capacities else None
        if capacities is not None and form is None:
            raise ConfigError("capacities: this model has no form of fixed shapes as it is configured; leave them out")
        if cuda_graph and form is None:
            replay_image_encoder(self.model)
        if compiled:
            compile_static_parts(self.model)
        self.whole_frames: WholeFrames | None = None
        if form is not None:
            with torch.inference_mode():
                self.whole_frames = WholeFrames(form, self.device, captured)
        self.grid = grid
        self.settings = settings
        self.precision = precision
        self._memory: Any = None

    @property
    def memory(self) -> Any:
        """What is remembered, as the model takes it, on the detector's device; None for nothing."""
        return self._memory if self.whole_frames is None else self.whole_frames.memory

    @memory.setter
    def memory(self, memory: Any) -> None:
        if self.whole_frames is None:
            self._memory = memory.to(self.device) if memory is not None else None
        else:
            self.whole_frames.memory = memory

    @classmethod
    def load(cls, checkpoint: Path | str, device: torch.device | str = "cpu", **switches: Any) -> Self:
        """Rebuild a checkpoint's own model from the configuration in it; `switches` as for the constructor.

        Raises CheckpointError when the file is missing, damaged or not of this project.
        """
        path = Path(checkpoint)
        content = read_checkpoint(path)
        return cls.restore(restore_config(content["horizon3d"]["config"], []), content, path, device, **switches)

    @classmethod
    def restore(
        cls,
        config: Config,
        checkpoint: dict[str, Any],
        path: Path,
        device: torch.device | str,
        **switches: Any,
    ) -> Self:
        """The detector of a checkpoint that has been read already; `path` is for messages.

        Raises ConfigError for one of a phase that learns no boxes.
        """
        if config.phase.task != "detection":
            raise ConfigError(
                f"checkpoint={path}: {config.phase.name} of {config.model.name} learns no boxes (its task is "
                f"{config.phase.task}); give a checkpoint of a phase of detection"
            )
        model = restored_model(config, checkpoint, path)
        settings = config.data.reader_settings(config.model.sensors, config.image_size_px)
        return cls(model, config.grid.build(), settings, device, config.precision, **switches)

    def reset(self) -> None:
        """Forget everything: the next frame begins a new recording."""
        self.memory = None

    def frame(
        self,
        timestamp_s: float,
        global_from_ego: np.ndarray,  # [4, 4] float64; any fixed frame serves, the same one for all frames
        cameras: Mapping[str, Camera | None],
        radars: Mapping[str, Sequence[RadarSweep] | None],
        lidars: Mapping[str, Sequence[LidarSweep] | None] | None = None,
    ) -> FrameBatch:
        """A frame of one's own sensors, prepared as this detector was trained; see `frame_from_sensors`."""
        return frame_from_sensors(timestamp_s, global_from_ego, cameras, radars, self.settings, lidars=lidars)

    def step(self, frame: FrameBatch) -> Boxes3D:
        """Boxes of the next frame (a batch of one) in its ego frame, with scores, best first, on the CPU.

        Raises ValueError for a batch that is not one frame, is augmented, or lacks what the model reads.
        """
        if self.whole_frames is not None and not frame.past:
            self._begin(frame)
            with torch.inference_mode(), computing(self.precision, self.device):
                boxes = self.whole_frames.step(frame)
            if boxes is not None:
                return boxes
        return self.run(frame)[0].to("cpu")

    @torch.inference_mode()
    def run(self, frame: FrameBatch) -> tuple[Boxes3D, Any]:
        """Boxes of the next frame and the model's own output, both on the device; never in fixed shapes. See `step`."""
        self._begin(frame)
        with computing(self.precision, self.device):
            frame = frame.to(self.device)
            if frame.past:
                output = self.model.output_alone(frame, self.model.memory_of(frame.past))
            else:
                output, self.memory = self.model(frame, self.memory)
            (boxes,) = self.model.decode(output)
        return boxes, output

    def _begin(self, frame: FrameBatch) -> None:
        self._check(frame)
        if frame.starts is not None and bool(frame.starts[0]):
            self.reset()

    def _check(self, frame: FrameBatch) -> None:
        if len(frame) != 1:
            raise ValueError(f"one frame at a time: the batch must hold 1 frame, but got {len(frame)}")
        self._check_numbers(frame)
        if not torch.equal(frame.aug_from_ego[0].cpu(), torch.eye(4)):
            raise ValueError(
                f"frame {frame.tokens[0]}: aug_from_ego must be the identity, augmentation is for training"
            )
        for sensor, sweeps in (("radar", self.settings.num_sweeps), ("lidar", self.settings.num_lidar_sweeps)):
            if sweeps and getattr(frame, f"{sensor}_points") is None:
                raise ValueError(
                    f"frame {frame.tokens[0]}: {sensor}_points must be there for this model; no return is no row"
                )
        if self.settings.image_size_px is None:
            return
        wanted = [1, len(CAMERAS), 3, *self.settings.image_size_px]
        found = None if frame.images is None else list(frame.images.shape)
        if found != wanted:
            raise ValueError(
                f"frame {frame.tokens[0]}: images must be {wanted}, but got {found}; a missing camera is a black image "
                "with image_valid False"
            )

    def _check_numbers(self, frame: FrameBatch) -> None:
        """Sensors' values already on a GPU are not looked at, which would have to be waited for."""
        values = {name: getattr(frame, name) for name in ("timestamps_s", "global_from_ego")}
        if frame.device.type == "cpu":
            values |= {name: getattr(frame, name) for name in ("radar_points", "lidar_points")}
            if frame.image_valid is not None:
                values["pix_from_aug"] = frame.pix_from_aug[frame.image_valid]
        for name, value in values.items():
            if value is not None and not torch.isfinite(value).all():
                raise ValueError(f"frame {frame.tokens[0]}: {name} must be finite")
