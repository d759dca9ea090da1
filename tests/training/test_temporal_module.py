"""Whose memory a stream gets, and when it ends."""

import logging
from dataclasses import replace

import pytest
import torch

from src.models.detector import Detector
from src.train import durations
from src.training.module import TrainingModule
from tests.training.toys import ToyMemory, toy_batch, toy_module


def past(module, batch):
    """What the model is given for each row: NaN-free numbers, 0 for nothing."""
    memory = module.select_memory(batch)
    return None if memory is None else memory.values.tolist()


@pytest.fixture
def module():
    """After one batch of the streams 5, 3 and 8, which remember 50, 30 and 80."""
    module = toy_module().eval()
    module.run(toy_batch([5, 3, 8], [True] * 3))
    ((_, memory),) = module.memories
    assert memory.values.shape == (3,)
    memory.values[:] = torch.tensor([50.0, 30.0, 80.0])
    return module


def test_the_first_batch_has_no_memory():
    module = toy_module().eval()
    batch = toy_batch([0, 1], [False, False])
    assert module.select_memory(batch) is None
    output = module.run(batch)
    ((streams, memory),) = module.memories
    assert streams.tolist() == [0, 1] and torch.equal(memory.values, output) and not memory.values.requires_grad


def test_rows_follow_their_streams(module):
    assert past(module, toy_batch([8, 5, 3], [False] * 3)) == [80, 50, 30]


def test_a_start_ends_the_memory_of_its_stream_alone(module):
    assert past(module, toy_batch([5, 3, 8], [False, True, False])) == [50, 0, 80]


def test_vanished_and_new_streams(module):
    assert past(module, toy_batch([8, 3], [False] * 2)) == [80, 30]
    assert past(module, toy_batch([4, 8], [False] * 2)) == [0, 80]
    module.run(toy_batch([8], [False]))
    assert past(module, toy_batch([5, 3], [False] * 2)) is None  # missed a batch, so they begin anew


def test_sets_of_streams_take_turns(module):
    module.run(toy_batch([1, 2], [True, True]))
    assert len(module.memories) == 2 and past(module, toy_batch([3, 5, 8], [False] * 3)) == [30, 50, 80]
    module.run(toy_batch([5, 3, 8], [False] * 3, number=1))
    assert sorted(streams.tolist() for streams, _ in module.memories) == [[1, 2], [5, 3, 8]]
    assert past(module, toy_batch([1, 2], [True, False]))[0] == 0


def test_nothing_left_is_none(module):
    assert past(module, toy_batch([5, 3], [True, True])) is None
    assert past(module, toy_batch([1, 2], [False, False])) is None


def test_the_output_uses_the_memory(module):
    batch = toy_batch([5, 3, 8], [False, True, False], number=1)
    alone, _ = module.model(batch)
    assert torch.allclose(module.run(batch) - alone, torch.tensor([50.0, 0.0, 80.0]), atol=1e-4)


def test_frames_with_a_past_remember_it_as_an_evaluation_would_and_nothing_else(module):
    """Without dropout and gradient, from an empty memory, whatever the streams hold."""
    first, second, batch = (toy_batch(None, None, number) for number in range(3))
    module.train()
    torch.manual_seed(0)
    output = module.run(replace(batch, past=(first, second)))
    assert module.model.training and len(module.memories) == 1
    module.model.eval()
    with torch.no_grad():
        wanted = module.model(second, module.model(first)[1])[1]
    module.model.train()
    torch.manual_seed(0)
    assert torch.equal(output, module.model(batch, wanted)[0])
    module.forget_step(batch)
    module.eval()


def test_the_last_frame_of_the_past_is_learnt_through_where_the_model_asks_for_it(module):
    """In training alone; the frames before it are remembered as ever."""
    seen = []

    class Learner(type(module.model)):
        trains_last_transition = True

        def transition(self, batch, memory):
            seen.append((self.training, torch.is_grad_enabled(), None if memory is None else memory.values))
            return ToyMemory(self.forward(batch, memory)[0])

    module.model.__class__ = Learner
    first, second, third = (toy_batch(None, None, number) for number in range(3))
    wanted = module.remember((first, second))
    assert {entry[:2] for entry in seen} == {(False, False)} and not wanted.values.requires_grad
    module.train()
    memory = module.remember((first, second, third))
    assert memory.values.requires_grad and module.model.training
    assert {entry[:2] for entry in seen[:-1]} == {(False, False)}
    assert seen[-1][:2] == (True, True) and torch.equal(seen[-1][2], wanted.values)


def test_depth_and_age_of_the_memory_are_logged(module):
    module.log = lambda *arguments, **named: None
    module.run(toy_batch([1, 2], [True, True]))
    found = module.objective(toy_batch([5, 3, 8], [False, True, False], number=1)).diagnostics
    assert (float(found["memory_frames"]), float(found["memory_steps"])) == (pytest.approx(2 / 3), 2.0)  # two sets
    past = (toy_batch(None, None, 3),)
    found = module.objective(replace(toy_batch(None, None, 4), past=past)).diagnostics
    assert (float(found["memory_frames"]), float(found["memory_steps"])) == (1.0, 0.0)
    found = module.objective(toy_batch([9], [True])).diagnostics
    assert (float(found["memory_frames"]), float(found["memory_steps"])) == (0.0, 0.0)


def test_batches_without_streams_are_refused(module):
    with pytest.raises(ValueError, match="FrameBatch.streams"):
        module.run(toy_batch(None, None))


def test_single_frames_have_no_memory():
    module = toy_module(TrainingModule).eval()
    batch = toy_batch([0, 1], [False, False])
    assert torch.equal(module.run(batch), module.run(batch))
    assert "memories" not in module.rank_state()


def test_memory_ends_between_training_and_validation(module):
    for begins in (module.on_train_epoch_start, module.on_validation_epoch_start):
        module.memories.append((torch.tensor([0]), "something"))
        begins()
        assert not module.memories


def test_state_is_restored_for_the_same_streams(module, tmp_path):
    module.means.update("loss/near", 0.1, 3)
    torch.save(module.rank_state(), tmp_path / "state")
    other = toy_module(seed=0).eval()
    other.restore_rank(torch.load(tmp_path / "state", weights_only=True))
    batch = toy_batch([3, 5], [False, False], number=1)
    assert past(other, batch) == [30, 50]
    assert torch.equal(other.run(batch), module.run(batch))
    assert other.rank_state()["means"] == module.rank_state()["means"]


class Trainer:
    """What a module asks of its trainer when it loads a checkpoint."""

    def __init__(self, rank, world_size):
        self.global_rank, self.world_size = rank, world_size


def load(module, states, rank, world_size):
    module._trainer = Trainer(rank, world_size)
    module.on_load_checkpoint({"horizon3d": {"config": {}, "ranks": states}})
    return module


def test_the_time_of_a_resumed_run_adds_up(monkeypatch):
    def saved(module):
        checkpoint = {}
        module.on_save_checkpoint(checkpoint)
        return checkpoint

    now = 100.0
    monkeypatch.setattr("src.training.module.time.monotonic", lambda: now)
    first, now = toy_module(), 107.0
    checkpoint = saved(first)
    second = toy_module()  # at 107
    second._trainer = Trainer(0, 1)
    second.on_load_checkpoint(checkpoint)
    assert second.earlier_s == 7.0
    now = 110.0
    assert saved(second)["horizon3d"]["seconds"] == 10.0
    assert durations(1.5, 2.5, second.earlier_s) == {"fit": 8.5, "all": 9.5, "earlier": 7.0}
    older = load(toy_module(), [], 0, 1)  # its checkpoint does not say
    assert older.earlier_s is None and saved(older)["horizon3d"]["seconds"] is None
    assert durations(1.5, 2.5, None) == {"fit": 1.5, "all": 2.5}


def test_a_restored_memory_follows_the_module_to_its_device(module):
    """A checkpoint is read while the module still lies on the CPU; here a device without values stands for a GPU."""
    other = toy_module()
    other.restore_rank(module.rank_state())
    other.to("meta")
    other.on_fit_start()
    ((streams, memory),) = other.memories
    assert streams.device.type == memory.values.device.type == "meta"


def test_each_rank_takes_its_own_part():
    states = [
        {
            "means": {"a": [1.0, 2.0]},
            "memories": [{"streams": [rank], "frames": [{"values": torch.tensor([7.0 + rank])}]}],
        }
        for rank in range(2)
    ]
    module = load(toy_module(), states, rank=1, world_size=2)
    assert past(module, toy_batch([0, 1], [False, False])) == [0, 8]


def test_another_number_of_ranks_keeps_the_means_and_drops_the_memory(caplog):
    memory = {"streams": [0], "frames": [{"values": torch.zeros(1)}]}
    states = [
        {"means": {"a": [1.0, 2.0], "b": [5.0, 1.0]}, "memories": [memory]},
        {"means": {"a": [3.0, 6.0]}, "memories": []},
    ]
    with caplog.at_level(logging.WARNING):
        module = load(toy_module(), states, rank=0, world_size=1)
        silent = load(toy_module(), states, rank=2, world_size=3)
    assert not module.memories and "2 processes, this run has 1" in caplog.text
    assert module.rank_state()["means"] == {"a": [4.0, 8.0], "b": [5.0, 1.0]}
    assert silent.rank_state() == {"means": {}, "memories": []}


def test_a_detector_of_single_frames_has_no_memory_to_restore():
    with pytest.raises(NotImplementedError, match="ToyDetector"):
        Detector.restore_memory(toy_module().model, [])
