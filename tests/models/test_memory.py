"""Motion of several remembered frames at once."""

import torch

from src.models.memory import RememberedFrame, motions
from tests.models.moving import UTM, bare_frame, bda, pose


def test_frames_together_move_as_each_alone_to_the_last_bit():
    """Streams that are absent, too old, not in the past or jumped among them."""
    poses = [pose(20.0, 3.0, 0.4, UTM), pose(1.0, 0.0), pose(0.0, 0.0)]
    now = bare_frame([4.0, 4.5, 4.0], poses, [bda(0.3), bda(), bda()])
    frames = []
    for age in range(5):
        past = bare_frame(
            [3.5 - age, 4.5 - age, 4.0 - 0.5 * age],
            [pose(9.0 - age, 2.0, 0.3 * age, UTM), pose(0.0, float(age), -0.1), pose(1000.0 * (age == 2), 0.0)],
        )
        present = torch.tensor([True, age != 3, True])
        frames.append(RememberedFrame(past.timestamps_s, past.global_from_ego, present))
    together = motions(frames, now, max_age_s=3.0)
    alone = [frame.motion(now, 3.0) for frame in frames]
    for name in ("aug_from_past", "elapsed_s", "usable"):
        assert torch.equal(getattr(together, name), torch.stack([getattr(one, name) for one in alone])), name
    assert 0 < together.usable.sum() < together.usable.numel()
