"""What a phase file may name: the module that trains it (`phase.module`), the evaluator of its task (`phase.task`)."""

from __future__ import annotations

from src.training.evaluator import DetectionEvaluator, Evaluator
from src.training.module import TrainingModule
from src.training.temporal_module import TemporalModule

MODULES: dict[str, type[TrainingModule]] = {kind.__name__: kind for kind in (TrainingModule, TemporalModule)}
EVALUATORS: dict[str, type[Evaluator]] = {"detection": DetectionEvaluator}
