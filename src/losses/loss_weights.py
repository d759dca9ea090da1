"""What a model's loss weights have in common (`model.loss`)."""

from __future__ import annotations

from dataclasses import dataclass, fields

from src.errors import ConfigError


@dataclass(kw_only=True)
class LossWeights:
    """Weights by term, fields `*_weight`; null switches a term off. Raises ConfigError for a negative one."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_weight") and value is not None and value < 0:
                raise ConfigError(f"model.loss.{field.name}={value}: must not be negative; null switches a term off")
