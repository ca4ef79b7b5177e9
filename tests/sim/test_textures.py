"""Generated patterns: seeded, rich at every scale, band-limited per level."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from visctrl.sim.render.textures import (
    BASE_DENSITY,
    FINEST_SIGMA_M,
    LEVELS,
    Kind,
    Levels,
    Pattern,
    periodic_noise,
)

PATTERN = Pattern(1.0, 1.0, "blobs", 0.5, 0.35, 0.0, "panel", 7)


def octave_spreads(image: NDArray[np.float32]) -> list[float]:
    """Return the standard deviation of each octave band, the finest first."""
    spreads = []
    last = image
    for k in range(1, 7):
        blurred = cv2.GaussianBlur(image, (0, 0), 2.0**k)
        spreads.append(float((last - blurred).std()))
        last = blurred
    return spreads


@pytest.mark.parametrize("kind", ["blobs", "noise"])
def test_there_is_content_at_every_scale(kind: Kind) -> None:
    spreads = octave_spreads(replace(PATTERN, kind=kind).base())
    # Grey levels per octave, from 4 to 250 mm.
    assert min(spreads) > 4.0
    assert max(spreads) < 8 * min(spreads)


def test_content_depends_on_seed_and_name_only() -> None:
    base = PATTERN.base()
    assert np.array_equal(base, replace(PATTERN).base())
    for other in (replace(PATTERN, seed=8), replace(PATTERN, name="other")):
        assert abs(np.corrcoef(base.ravel(), other.base().ravel())[0, 1]) < 0.3


def test_shade_and_contrast_are_what_they_say() -> None:
    base = replace(PATTERN, kind="noise", shade=0.4, contrast=0.2).base()
    assert base.mean() / 255 == pytest.approx(0.4, abs=0.05)
    assert base.min() >= 255 * 0.2 - 1
    assert base.max() <= 255 * 0.6 + 1


def test_the_margin_is_plain() -> None:
    base = replace(PATTERN, margin_m=0.1).base()
    rim = round(0.04 * BASE_DENSITY)
    edges = np.concatenate([base[:rim].ravel(), base[-rim:].ravel(), base[:, :rim].ravel()])
    assert np.ptp(edges) < 1e-3
    assert base[100:150, 100:150].std() > 5


@pytest.mark.parametrize("level", range(LEVELS))
def test_levels_are_blurred_as_much_as_they_say(level: int) -> None:
    levels = Levels(PATTERN)
    image = levels.image(level, 1.0).astype(np.float32)
    sigma = FINEST_SIGMA_M * 2.0**level * BASE_DENSITY
    expected = cv2.GaussianBlur(PATTERN.base(), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    found = cv2.resize(image, expected.shape[::-1], interpolation=cv2.INTER_CUBIC)
    inner = slice(40, -40)
    difference = (found - expected)[inner, inner]
    assert difference.std() < 0.06 * expected.std() + 0.5
    assert abs(difference.mean()) < 0.5


def test_periodic_noise_has_no_seam() -> None:
    noise = periodic_noise(np.random.default_rng(1), 256)
    inside = np.abs(np.diff(noise, axis=0)).mean()
    assert np.abs(noise[0] - noise[-1]).mean() < 1.3 * inside
    assert np.abs(noise[:, 0] - noise[:, -1]).mean() < 1.3 * inside
