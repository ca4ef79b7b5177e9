"""Small tilts of a camera, frame by frame, drawn into its finished images.

Whatever draws them: a rotation about the projection centre takes every pixel's ray to another
ray of the same image, so that an image of the upright camera holds all that is needed.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

_STREAM = 3


class Shake:
    """Rolls and pitches a camera at random.

    Parameters
    ----------
    camera : CentralCamera
        Whose images are tilted.
    sd_deg : float
        Standard deviation of the roll, and of the pitch, in each frame.
    seed : int
        Of the tilts.
    """

    def __init__(self, camera: CentralCamera, sd_deg: float, seed: int) -> None:
        self._camera = camera
        self._sd = math.radians(sd_deg)
        self._seed = seed
        pixels = np.stack(
            np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1
        ).astype(np.float64)
        rays, seen = camera.robot_rays(pixels)
        self._rays = np.where(seen[..., None], rays, [0.0, 1.0, 0.0])
        self._seen = seen

    def tilted(self, image: Image, sequence: int) -> Image:
        """Return the image (H, W) that the camera takes when tilted; one tilt for a number."""
        rng = np.random.default_rng([self._seed, _STREAM, sequence])
        pitch, roll = rng.normal(0.0, self._sd, 2).tolist()
        # Where each pixel of the tilted camera looks, in the upright camera's image.
        rotation, _ = cv2.Rodrigues(np.array([pitch, roll, 0.0]))
        pixels, inside = self._camera.robot_pixels(self._rays @ rotation.T)
        shown = inside & self._seen
        at = np.where(shown[..., None], pixels, -9.0).astype(np.float32)
        return np.asarray(
            cv2.remap(image, at[..., 0].copy(), at[..., 1].copy(), cv2.INTER_CUBIC), np.uint8
        )
