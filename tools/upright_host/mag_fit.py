"""Hard and soft iron out of a tumble: an ellipsoid through the magnetometer's counts, and how good it is."""

from dataclasses import dataclass

import numpy as np

from upright_host.console import Wrong

LEAST_MAG = 200  # samples
LEAST_COVERAGE = 0.7  # of the sphere
_SECTORS = 60  # of equal area, about 30 deg across
# smallest to largest variance of the cloud: 1/3 of the length; 1/4 is a half sphere
LEAST_SPREAD = 1 / 9
MOST_AXES = 2.5  # longest to shortest axis of the ellipsoid; soft iron of a board: 1.2
MOST_RESIDUAL = 0.10  # of the field
DOUBTFUL_RESIDUAL = 0.04
DOUBTFUL_OUTLIERS = 0.05  # of the samples


@dataclass
class MagFit:
    """corrected = matrix (raw - offset); |corrected| is the field's strength, all in counts.

    matrix is the symmetric root of the ellipsoid, of determinant 1: `strength` is the geometric mean of the three
    semi-axes, so the field neither grows nor shrinks. before, after: standard deviation of the strength, relative.
    """

    offset: np.ndarray
    matrix: np.ndarray
    strength: float
    before: float
    after: float
    samples: int
    outliers: int
    coverage: float


def fit_ellipsoid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(centre c, A) with (p - c)' A (p - c) = 1 for points (n, 3): the least squares that can only give an ellipsoid.

    Q. Li, J. G. Griffiths, Least Squares Ellipsoid Specific Fitting, Geometric Modeling and Processing 2004, with
    k = 4: the algebraic distance is minimised under 4J - I^2 = 1, an eigenvalue problem of which exactly one
    eigenvalue is positive.
    """
    middle = points.mean(0)
    size = np.linalg.norm(points - middle, axis=1).mean()
    x, y, z = ((points - middle) / size).T
    one = np.ones_like(x)
    d = np.stack([x * x, y * y, z * z, 2 * y * z, 2 * x * z, 2 * x * y, 2 * x, 2 * y, 2 * z, one])
    s = d @ d.T
    constraint = np.diag([-2.0, -2, -2, -4, -4, -4])
    constraint[:3, :3] += 1
    rest = np.linalg.solve(s[6:, 6:], s[6:, :6])
    values, vectors = np.linalg.eig(np.linalg.solve(constraint, s[:6, :6] - s[:6, 6:] @ rest))
    v = vectors[:, np.argmax(values.real)].real
    a = np.array([[v[0], v[5], v[4]], [v[5], v[1], v[3]], [v[4], v[3], v[2]]])
    *b, c = -rest @ v
    centre = -np.linalg.solve(a, b)
    return middle + size * centre, a / (centre @ a @ centre - c) / size**2


def fit_mag(points: np.ndarray) -> MagFit:
    """The hard and soft iron of a tumble, counts (n, 3). Raises Wrong for one that cannot tell them."""
    if len(points) < LEAST_MAG:
        raise Wrong(
            f"{len(points)} magnetometer samples are too few, {LEAST_MAG} are needed: record for a minute, "
            "turning the board slowly through all directions"
        )
    spread = np.linalg.eigvalsh(np.cov(points.T))
    if spread[0] <= LEAST_SPREAD * spread[2]:
        raise Wrong(
            "the board was turned about one axis only, or hardly: the samples lie in a plane "
            f"({np.sqrt(max(spread[0], 0)):.0f} counts thick, {np.sqrt(spread[2]):.0f} wide). Turn it about all "
            "three axes, each of its six faces up once"
        )
    kept = np.ones(len(points), bool)
    try:
        for _ in range(10):
            centre, a = fit_ellipsoid(points[kept])
            distance = points - centre
            squared = np.einsum("ni,ij,nj->n", distance, a, distance)
            off = np.sqrt(np.maximum(squared, 0)) - 1
            middle = np.median(off[kept])
            most = max(4 * 1.4826 * np.median(np.abs(off[kept] - middle)), 0.005)
            before, kept = kept, np.abs(off - middle) <= most
            if (before == kept).all() or kept.sum() < LEAST_MAG:
                break
        weights, vectors = np.linalg.eigh(a)
    except np.linalg.LinAlgError:
        weights = np.zeros(3)
    if weights[0] <= 0 or weights[2] > MOST_AXES**2 * weights[0] or kept.sum() < LEAST_MAG:
        raise Wrong(
            "the samples lie on no ellipsoid that soft iron could make (its axes would differ by more than "
            f"{MOST_AXES:g} to 1): record again, away from iron and magnets, through all directions"
        )
    strength = float(np.prod(weights) ** (-1 / 6))
    matrix = (vectors * np.sqrt(weights) * strength) @ vectors.T
    corrected = (points[kept] - centre) @ matrix
    coverage, missing = cover(corrected)
    if coverage < LEAST_COVERAGE:
        more = f"; nothing near the field along {', '.join(missing)}" if missing else ""
        raise Wrong(
            f"the tumble covers {coverage:.0%} of all directions, {LEAST_COVERAGE:.0%} are needed{more}. Record "
            "for longer, each of the six faces up once, and turn slowly about the vertical meanwhile"
        )
    lengths = np.linalg.norm(corrected, axis=1)
    raw = np.linalg.norm(points[kept], axis=1)
    after = lengths.std() / lengths.mean()
    if after > MOST_RESIDUAL:
        raise Wrong(
            f"after the correction the field's strength still varies by {after:.0%} (rms): it was disturbed, or the "
            "board was not turned. Record again, away from iron, magnets, motors and loudspeakers"
        )
    return MagFit(
        centre,
        matrix,
        strength,
        raw.std() / raw.mean(),
        after,
        len(points),
        int((~kept).sum()),
        coverage,
    )


def cover(vectors: np.ndarray) -> tuple[float, list[str]]:
    """How much of the sphere the directions (n, 3) cover, 0..1, and the half axes with none within 35 deg."""
    unit = vectors / np.linalg.norm(vectors, axis=1)[:, None]
    i = np.arange(_SECTORS)
    z = 1 - (2 * i + 1) / _SECTORS  # a Fibonacci lattice: sectors of equal area
    turn = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    lattice = np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)
    filled = np.unique(np.argmax(unit @ lattice.T, 1))
    near = np.cos(np.radians(35))
    names = [s + axis for axis in "xyz" for s in "+-"]
    most = np.stack([unit.max(0), -unit.min(0)], 1).ravel()
    return len(filled) / _SECTORS, [name for name, m in zip(names, most, strict=True) if m < near]
