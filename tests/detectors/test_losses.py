"""Per-image losses, candidates and detections of every detector (section 3.2)."""

from __future__ import annotations

import pytest
import torch
from detector_images import NAMES, bar_images

from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.loaded import build_detector
from skyproof.errors import ConfigurationError
from skyproof.storage import weights_digest

LABELLED = bar_images(6, seed=1)
IMAGES = torch.stack(LABELLED.images(range(len(LABELLED)))).float() / 255
BOXES = list(LABELLED.boxes)
NOTHING = [torch.zeros(0, 4)] * len(BOXES)


@torch.no_grad()
def best_scores(detector: TrainableDetector) -> torch.Tensor:
    """The highest score in each of the images."""
    return detector.candidates(IMAGES).scores.amax(dim=1)


@pytest.mark.parametrize("targets", [BOXES, NOTHING], ids=["truth", "empty"])
def test_loss_of_an_image_does_not_depend_on_its_batch(
    trained: TrainableDetector, targets: list
) -> None:
    together = trained.loss(IMAGES, targets)
    alone = torch.cat(
        [trained.loss(IMAGES[i : i + 1], targets[i : i + 1]) for i in range(len(IMAGES))]
    )
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)


def test_loss_is_deterministic(trained: TrainableDetector) -> None:
    torch.manual_seed(0)
    first = trained.loss(IMAGES, BOXES)
    torch.manual_seed(1)
    assert torch.equal(first, trained.loss(IMAGES, BOXES))


def test_empty_truth_costs_where_a_vehicle_is_seen_and_little_where_none_is(
    trained: TrainableDetector,
) -> None:
    losses = trained.loss(IMAGES, NOTHING)
    count = torch.tensor([len(boxes) for boxes in BOXES])
    best = best_scores(trained)
    assert torch.isfinite(losses).all()
    assert (losses > 0).all()
    # So few steps do not teach every vehicle on every processor, but some, and no ground.
    assert (best > 0.5).any()
    assert (best[count == 0] < 0.5).all()
    assert losses[best > 0.5].min() > losses[count == 0].max()
    assert losses[count == 1].max() < 10


def test_an_image_without_any_doubt_still_costs_something() -> None:
    generator = torch.Generator().manual_seed(0)
    detector = build_detector("faster_rcnn", "slim", generator=generator).eval()
    with torch.no_grad():
        detector.model.rpn.head.cls_logits.bias.sub_(25)
        detector.model.roi_heads.box_predictor.cls_score.bias.copy_(torch.tensor([20.0, -20.0]))
    images = IMAGES.clone().requires_grad_()
    losses = detector.loss(images, NOTHING)
    assert (losses > 0).all()
    assert (losses < 1e-9).all()
    losses.sum().backward()
    assert images.grad is not None
    assert (images.grad.abs().amax(dim=(1, 2, 3)) > 0).all()


def test_gradient_reaches_the_vehicle_and_a_step_lowers_its_score(
    trained: TrainableDetector,
) -> None:
    index = int(best_scores(trained).argmax())
    images = IMAGES[index : index + 1].clone().requires_grad_()
    before = trained.candidates(images).scores.max()
    trained.loss(images, NOTHING[:1]).sum().backward()
    gradient = images.grad
    assert gradient is not None
    assert torch.isfinite(gradient).all()
    step = images.detach() - 0.05 * gradient.sign()
    assert trained.candidates(step.clamp(0, 1)).scores.max() < before


def test_weights_and_buffers_stay_as_they_are_during_an_attack(trained: TrainableDetector) -> None:
    digest = weights_digest(trained)
    images = IMAGES.clone().requires_grad_()
    (trained.loss(images, NOTHING).sum() + trained.candidates(images).scores.sum()).backward()
    trained.detect(IMAGES)
    assert weights_digest(trained) == digest


def test_loss_is_finite_in_train_mode(trained: TrainableDetector) -> None:
    detector = build_detector(
        trained.name, "slim", generator=torch.Generator().manual_seed(3)
    ).train()
    for targets in (BOXES, NOTHING):
        detector.zero_grad()
        loss = detector.loss(IMAGES, targets).mean()
        loss.backward()
        gradients = [
            parameter.grad for parameter in detector.parameters() if parameter.grad is not None
        ]
        assert torch.isfinite(loss)
        assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_candidates_are_differentiable_and_detections_sorted(trained: TrainableDetector) -> None:
    images = IMAGES.clone().requires_grad_()
    found = trained.candidates(images)
    assert found.boxes.shape == (*found.scores.shape, 4)
    found.scores.max().backward()
    assert images.grad is not None
    assert images.grad.abs().sum() > 0
    for detections in trained.detect(IMAGES):
        assert len(detections.scores) <= 100
        assert (detections.scores >= 0.01).all()
        assert torch.equal(detections.scores, detections.scores.sort(descending=True).values)
        assert (detections.boxes >= 0).all()
        assert (detections.boxes <= 96).all()


def test_images_are_never_resized(trained: TrainableDetector) -> None:
    """A vehicle keeps its pixels when the tile grows, also to a size off the stride."""
    index = int(best_scores(trained).argmax())
    large = torch.full((1, 3, 150, 171), 0.3)
    large[:, :, :96, :96] = IMAGES[index]
    small_best = trained.detect(IMAGES[index : index + 1])[0].boxes[0]
    large_boxes = trained.detect(large)[0].boxes
    assert (large_boxes - small_best).abs().amax(dim=1).min() < 4


def test_too_small_images_and_missing_targets_are_refused(trained: TrainableDetector) -> None:
    with pytest.raises(ConfigurationError, match="at least 96 px"):
        trained.detect(torch.zeros(1, 3, 64, 200))
    with pytest.raises(ConfigurationError, match="one tensor of boxes per image"):
        trained.loss(IMAGES, BOXES[:2])


def test_unknown_names_and_sizes_are_refused() -> None:
    for name, size in (("ssd", "slim"), ("retinanet", "tiny"), ("faster_rcnn", "tiny")):
        with pytest.raises(ConfigurationError):
            build_detector(name, size, generator=torch.Generator())


def test_same_generator_same_weights_and_global_state_untouched() -> None:
    state = torch.get_rng_state()
    digests = {
        weights_digest(
            build_detector("retinanet", "slim", generator=torch.Generator().manual_seed(seed))
        )
        for seed in (5, 5, 6)
    }
    assert len(digests) == 2
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize(
    ("name", "first_numbers"), [("retinanet", 0.733099), ("faster_rcnn", 0.659226)]
)
def test_a_seed_gives_slim_networks_the_initial_weights_it_always_gave(
    name: str, first_numbers: float
) -> None:
    # One number of each kernel: they say both the shapes and the order in which all were drawn,
    # and not how a processor rounds.
    detector = build_detector(name, "slim", generator=torch.Generator().manual_seed(5))
    kernels = [kernel.flatten()[0] for kernel in detector.parameters() if kernel.ndim > 1]
    assert float(torch.stack(kernels).detach().abs().sum()) == pytest.approx(
        first_numbers, rel=1e-4
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_full_size_gives_finite_losses_and_gradients(name: str) -> None:
    detector = (
        build_detector(name, "full", generator=torch.Generator().manual_seed(0))
        .eval()
        .requires_grad_(False)
    )
    images = IMAGES[1:3].clone().requires_grad_()
    losses = detector.loss(images, BOXES[1:3]) + detector.loss(images, NOTHING[1:3])
    losses.sum().backward()
    assert torch.isfinite(losses).all()
    assert images.grad is not None
    assert torch.isfinite(images.grad).all()
    assert len(detector.detect(IMAGES[1:3])) == 2
