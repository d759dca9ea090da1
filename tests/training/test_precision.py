"""Training and scoring compute in the precision that is asked for."""

import pytest
import torch

from src.ops import products
from src.ops.precision import Precision, computing
from src.training.fit import build_evaluation_trainer, fit
from src.training.run_folder import Resume, RunFolder
from tests.training.toys import ToyData, ToyDetector, toy_module, toy_trainer


@pytest.fixture
def seen(monkeypatch):
    """(training, type of a large product, autocast) of every forward pass."""
    monkeypatch.setattr(products, "multiplies_bfloat16", lambda: True)
    found, forward = set(), ToyDetector.forward

    def watched(self, *args):
        product = products.product_type(torch.zeros(4096, 64), 64)
        found.add((self.training, product, torch.is_autocast_enabled("cpu")))
        return forward(self, *args)

    monkeypatch.setattr(ToyDetector, "forward", watched)
    return found


@pytest.mark.parametrize("precision", Precision)
def test_trainings_and_evaluations_agree(precision, seen, tmp_path):
    expected = torch.bfloat16 if precision == "bf16-products" else torch.float32, precision == "bf16-mixed"
    module, data = toy_module(), ToyData()
    folder = RunFolder(tmp_path, "run")
    folder.open(Resume.auto)
    fit(toy_trainer(folder, precision=precision, epochs=1), module, data, None)
    assert seen == {(training, *expected) for training in (True, False)}
    seen.clear()
    trainer = build_evaluation_trainer(precision, "cpu")
    trainer.progress_bar_callback.disable()
    trainer.validate(module, dataloaders=data_of(data), verbose=False)
    assert seen == {(False, *expected)}
    assert products.product_type(torch.zeros(4096, 64), 64) == torch.float32
    with computing(precision, torch.device("cpu")):  # commands that have no trainer
        module.model.eval()(next(iter(data_of(data))))
    assert seen == {(False, *expected)}


def data_of(data):
    data.trainer = type("Trainer", (), {"global_rank": 0})
    return data.val_dataloader()


def test_the_record_says_what_was_chosen(monkeypatch):
    for able in (True, False):
        monkeypatch.setattr(products, "multiplies_bfloat16", lambda able=able: able)
        assert (products.describe_products(True)["bfloat16"] == "never") != able
        assert products.describe_products(False)["bfloat16"] == "never"
