"""What any detector must do: learn with every parameter, keep samples apart, weigh its losses."""

from dataclasses import replace

import numpy as np
import pytest
import torch


def train_step(model, batch):
    output = model(batch)[0]
    terms = model.loss(output, batch).terms
    model.zero_grad()
    terms["total"].backward()
    return output, terms


def gradients_are_finite(model):
    """Every parameter has a gradient, zero where its part had nothing to do: DDP waits for each of them."""
    return all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


def little_input_gives_finite_losses(model, batch):
    """Finite losses and gradients, and boxes of each sample, of frames in which points or objects lack."""
    _, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    assert len(model.eval().decode(model(batch)[0])) == len(batch)


def autocast_step(model, batch):
    """Output of a step under bfloat16; its losses are float32 and finite, as its gradients are."""
    with torch.autocast("cpu", torch.bfloat16):
        output, _ = model(batch)
        terms = model.loss(output, batch).terms
    terms["total"].backward()
    assert all(value.dtype == torch.float32 and value.isfinite() for value in terms.values())
    assert gradients_are_finite(model)
    return output


def parameters_that_stay(model, batch, lr):
    """Names of those without a gradient in both of two steps, but for branches' biases.

    An L1 term pulls a bias by +-1 per object, which an even number of objects can cancel exactly.
    """
    optimizer = torch.optim.SGD(model.parameters(), lr=lr)
    moved = set()
    for _ in range(2):
        train_step(model, batch)
        moved |= {name for name, p in model.named_parameters() if p.grad is not None and p.grad.any()}
        optimizer.step()
    still = {name for name, _ in model.named_parameters()} - moved
    return [name for name in sorted(still) if not (name.startswith("head.regressions") and name.endswith("bias"))]


def samples_do_not_mix(model, pair, make_batch):
    """Logits of two samples of radar and images are those of each alone."""
    with torch.no_grad():
        both = model(pair)[0].head.logits.view(2, -1, 12)
        for sample in range(2):
            rows = pair.radar_batch == sample
            single = make_batch(points=(0,), boxes=(0,))
            single.radar_points, single.radar_batch = pair.radar_points[rows], pair.radar_batch[rows] * 0
            single.images, single.pix_from_aug = pair.images[sample][None], pair.pix_from_aug[sample][None]
            logits = model(single)[0].head.logits.view(-1, 12)
            torch.testing.assert_close(logits, both[sample], atol=1e-4, rtol=1e-4)


def weight_multiplies_or_switches_off(model, batch, name, terms):
    """Twice `model.loss.<name>` is twice its term and no other; null leaves it out of `terms`."""
    term, loss = name.removesuffix("_weight"), model.config.loss
    output = model(batch)[0]
    plain = model.loss(output, batch).terms
    setattr(loss, name, 2.0 * getattr(loss, name))
    double = model.loss(output, batch).terms
    assert {key for key in plain if not torch.equal(plain[key], double[key])} == {term, "total"}
    torch.testing.assert_close(double[term], 2.0 * plain[term])
    setattr(loss, name, None)
    assert set(model.loss(output, batch).terms) == terms - {term}


def missing_cameras_do_not_matter(model, batch, missing):
    """Pixels of cameras [(sample, camera)] that are not there change nothing; losses and gradients are finite."""
    for sample, camera in missing:
        batch.image_valid[sample, camera] = False
        batch.pix_from_aug[sample, camera] = 0.0
    output, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    model.eval()
    before = model(batch)[0]
    for sample, camera in missing:
        batch.images[sample, camera] = 255 - batch.images[sample, camera]
    after = model(batch)[0]
    assert torch.equal(before.head.logits, after.head.logits)
    assert torch.equal(model.loss(before, batch).terms["total"], model.loss(after, batch).terms["total"])
    return output, terms


def images_and_annotations_are_needed(model, batch):
    """Their absence is named."""
    output = model(batch)[0]
    with pytest.raises(ValueError, match="FrameBatch.boxes is None"):
        model.loss(output, replace(batch, boxes=None))
    with pytest.raises(ValueError, match="FrameBatch.images is None"):
        model(replace(batch, images=None))


def overfitted_precision(model, batch, steps, rate, falling):
    """AP at one cell, averaged over the classes present, after so many steps on two frames; the last `falling` ones
    bring the learning rate to zero."""
    optimizer = torch.optim.AdamW(model.parameters())
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (steps - step) / falling)
        train_step(model, batch)
        torch.nn.utils.clip_grad_norm_(model.parameters(), 35.0)
        optimizer.step()
    with torch.no_grad():
        found = model.decode(model(batch)[0])  # in training mode: two frames are all the statistics there are
    return np.mean([average_precision(found, batch.boxes, label) for label in range(5)])


def average_precision(found, truth, label):
    """Mean precision at each object's recall, both frames ranked together; a hit is within 0.8 m and counts once."""
    ranked = sorted(
        ((float(s), frame, c) for frame, boxes in enumerate(found)
         for s, c, name in zip(boxes.scores, boxes.centers[:, :2], boxes.labels, strict=True) if name == label),
        key=lambda entry: -entry[0],
    )  # fmt: skip
    open_objects = [boxes.centers[boxes.labels == label, :2].clone() for boxes in truth]
    hits, precisions = 0, []
    for rank, (_, frame, centre) in enumerate(ranked, 1):
        near = (open_objects[frame] - centre).norm(dim=1) < 0.8
        if near.any():
            open_objects[frame][near.nonzero()[0]] = torch.inf
            hits += 1
            precisions.append(hits / rank)
    return sum(precisions) / sum(len(boxes.centers[boxes.labels == label]) for boxes in truth)
