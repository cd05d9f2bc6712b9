"""The light of a recording, estimated from how the colours of points vary with their normals.

The light is grey, far away and casts no shadow, and its radiance is L(w) = sum_k l_k Y_k(w) / Y_0, in real spherical
harmonics to order 2. A matte point of albedo a and normal n then has, in linear light, the colour

    a E(n),  E(n) = sum_k A_k l_k Y_k(n) / Y_0,  A = 1, 2/3, 1/4 in orders 0, 1, 2

(Ramamoorthi and Hanrahan 2001, "An Efficient Representation for Irradiance Environment Maps"; irradiance is pi E).
Albedo and light are known only up to a common factor. Here E is 1 at the brightest normal that was seen: points that
face the light keep their photographed colour, and albedos exceed 1 only where photographs are overexposed.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

ORDER = np.repeat([0, 1, 2], [1, 3, 5])
REFLECTED = np.array([1, 2 / 3, 1 / 4])[ORDER]  # A
LEAST_IRRADIANCE = 0.1  # of the greatest: below this, neither photographs nor the estimate say much
OUTLIER = 0.5  # relative to the expected colour: what differs more is another surface
RIDGE = 1e-5  # relative to the evidence: it decides where the normals of points turn by less than a quarter of a degree
ITERATIONS, SETTLED = 30, 1e-4

Sums = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Shading:
    """Colours of points seen at various normals. point (M,): the point's number, from 0; normals (M, 3); colours (M, 3)
    in linear light; weights (M,)."""

    point: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class Light:
    """A light. coefficients (9,): l; turn_deg: the root mean square angle by which the normals of single points turned.
    If it is near 0, the light is unknown and assumed to be the same from all directions."""

    coefficients: np.ndarray
    turn_deg: float

    def irradiance(self, normals: np.ndarray) -> np.ndarray:
        """Return E (N,) of unit normals (N, 3), at least LEAST_IRRADIANCE."""
        return (harmonics(normals) @ (REFLECTED * self.coefficients)).clip(LEAST_IRRADIANCE)

    def turned(self, rotation: np.ndarray) -> "Light":
        """Return the same light in other axes. rotation (3, 3): from the current axes to the new ones."""
        directions = np.random.default_rng(0).normal(size=(100, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radiance = harmonics(directions) @ self.coefficients
        return Light(np.linalg.lstsq(harmonics(directions @ rotation.T), radiance)[0], self.turn_deg)


def harmonics(directions: np.ndarray) -> np.ndarray:
    """Return Y_k / Y_0 (N, 9) in unit directions (N, 3)."""
    x, y, z = directions.T
    first = [np.ones_like(x), 3**0.5 * y, 3**0.5 * z, 3**0.5 * x]
    second = [x * y, y * z, (3 * z**2 - 1) / 12**0.5, x * z, (x**2 - y**2) / 2]
    return np.stack([*first, *(15**0.5 * term for term in second)], 1)


def fit_light(shading: Shading) -> Light:
    """Return the light that best explains the colours with one albedo per point.

    This is least squares on colours relative to the expected ones. Each colour is weighted by its expected brightness,
    to match the noise of photographs, and less the worse it fits (Geman-McClure). Two steps alternate: each albedo
    becomes the ratio of its colours to their irradiances, and the light takes a Gauss-Newton step in which the albedos
    follow (variable projection, Golub and Pereyra 1973). A ridge keeps the light uniform where the normals of points do
    not turn.
    """
    coefficients = np.eye(len(REFLECTED))[0]
    if not len(shading.point):
        return Light(coefficients, 0.0)
    sums = _sums_over(shading.point)
    basis = REFLECTED * harmonics(shading.normals)
    counts = shading.weights
    for _ in range(ITERATIONS):
        irradiance = (basis @ coefficients).clip(LEAST_IRRADIANCE)[:, None]
        albedo = sums(counts[:, None] * shading.colours) / sums(counts[:, None] * irradiance).clip(1e-12)
        brightness = np.linalg.norm(albedo, axis=1).clip(1e-6)
        error = np.linalg.norm(shading.colours / irradiance - albedo, axis=1) / brightness
        counts = shading.weights / (1 + (error / OUTLIER) ** 2) ** 2
        residual = (shading.colours * albedo).sum(1) / (brightness**2 * irradiance[:, 0]) - 1
        step = _step(sums, counts * brightness * irradiance[:, 0], basis / irradiance, residual, coefficients)
        coefficients = coefficients + step
        if np.abs(step).max() < SETTLED:
            break
    turned = shading.normals - sums(shading.normals) / sums(np.ones(len(basis)))[:, None]
    turn_deg = float(np.degrees(np.sqrt((turned**2).sum(1).mean())))
    return Light(coefficients / (basis @ coefficients).max(), turn_deg)


def _step(
    sums: Sums, weight: np.ndarray, slope: np.ndarray, residual: np.ndarray, coefficients: np.ndarray
) -> np.ndarray:
    """Return the change (9,) of the coefficients that best reduces residuals (M,) with weights (M,) and slopes (M, 9),
    if each point may become brighter or darker as a whole. The constant coefficient stays."""
    both = np.column_stack([slope[:, 1:], residual])
    both -= sums(weight[:, None] * both) / sums(weight).clip(1e-12)[:, None]
    squares = both.T @ (weight[:, None] * both) / weight.sum()
    ridge = RIDGE * np.eye(len(coefficients) - 1)
    change = np.linalg.solve(squares[:-1, :-1] + ridge, squares[:-1, -1] - ridge @ coefficients[1:])
    return np.concatenate([[0.0], change])


def _sums_over(point: np.ndarray) -> Sums:
    """Return a function that maps values (M, ...) to their sums (M, ...) over all observations of the same point."""
    of_point = csr_array((np.ones(len(point)), (point, np.arange(len(point)))))
    return lambda values: (of_point @ values)[point]
