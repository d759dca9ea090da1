"""What drives does so along its heading; the rest of the box codes is held by the tests of the heads."""

import torch

from src.ops.box_codes import along_heading


def test_what_drives_does_so_along_its_heading() -> None:
    """Positions on the x axis, so that the radial part is vx; headings of any length, and 180 degrees off."""
    tilted = [3.0, 4.0]  # 53 degrees from the line of sight
    rows = {
        "radial part kept": ([12.0, 14.0], tilted, [12.0, 16.0]),
        "heading reversed": ([12.0, 14.0], [-3.0, -4.0], [12.0, 16.0]),
        "at right angles: part along the heading": ([3.0, 20.0], [0.0, 0.5], [0.0, 20.0]),
        "no faster than 1 m/s": ([0.6, 0.7], tilted, [0.6, 0.7]),
        "more than 45 degrees from its heading": ([20.0, 0.0], tilted, [20.0, 0.0]),
    }
    velocities, headings, wanted = (torch.tensor(column) for column in zip(*rows.values(), strict=True))
    found = along_heading(velocities, headings, torch.tensor([[50.0, 0.0]]).expand(len(rows), 2))
    torch.testing.assert_close(found, wanted)
    assert along_heading(velocities[:0], headings[:0], velocities[:0]).shape == (0, 2)
