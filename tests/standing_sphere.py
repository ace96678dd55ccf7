"""Points on a sphere that stands on a container, as a cloud of it would have them."""

import numpy as np

RADIUS_M = 0.03
STAND_M = 0.07


def sphere_points(count, seed=0, noise_m=0.0, above=-1.0):
    """Even on a sphere that stands at z = 0.07; its lower part, below a fraction of the radius, is not seen."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] > above]
    points = RADIUS_M * normals + [0.0, 0.0, STAND_M + RADIUS_M]
    return points + noise_m * rng.standard_normal(points.shape), normals
