"""The progress bar of a training."""

from __future__ import annotations

import lightning as L
from lightning.pytorch.callbacks import TQDMProgressBar


class LossProgressBar(TQDMProgressBar):
    """Lightning's bar with the loss terms by their bare names."""

    def get_metrics(self, trainer: L.Trainer, module: L.LightningModule) -> dict[str, int | str | float]:
        """Terms of the last step, three digits each."""
        items = super().get_metrics(trainer, module)
        items.pop("v_num", None)
        return {
            name.removeprefix("step/").removeprefix("val/"): f"{value:.3g}" if isinstance(value, float) else value
            for name, value in items.items()
        }
