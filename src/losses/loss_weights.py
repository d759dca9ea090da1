"""What a model's loss weights have in common (`model.loss`)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

from src.errors import ConfigError


@dataclass(kw_only=True)
class LossWeights:
    """Weights by term, fields `*_weight`; null switches a term off. Raises ConfigError for a negative one or none."""

    factors: ClassVar[tuple[str, ...]] = ()
    """Fields `*_weight` that are no term's own: they multiply others."""

    def __post_init__(self) -> None:
        names = [field.name for field in fields(self) if field.name.endswith("_weight")]
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        terms = [name for name in names if name not in self.factors]
        if not given.keys() & set(terms):
            raise ConfigError(f"model.loss: {', '.join(terms)} are all null, so nothing would be learnt; give one")
        for name, value in given.items():
            if value < 0:
                raise ConfigError(f"model.loss.{name}={value}: must not be negative; null switches a term off")
