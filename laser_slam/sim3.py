"""Similarity transforms: points of one frame to another by ``s * R @ p + t``."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import DegenerateGeometryError

Array = NDArray[np.float64]

STEPS_OF_VELOCITY = 5  # the last steps are the least certain: average a few


def _identity_rotation() -> Array:
    return np.eye(3)


def _zero_translation() -> Array:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class Sim3:
    """Map points of one frame to another: ``s * rotation @ p + translation``, in float64.

    Named ``b_from_a``; composes with ``@`` as functions do.

    Attributes:
        scale: units of the target per unit of the source, > 0.
        rotation: (3, 3) in SO(3).
        translation: (3,) in units of the target.

    Raises:
        DegenerateGeometryError: not finite, scale not positive, or no rotation (skewed, mirrored).

    >>> b_from_a = Sim3(scale=2.0, translation=np.array([1.0, 0.0, 0.0]))
    >>> (b_from_a @ b_from_a.inverse()).scale
    1.0
    >>> b_from_a.apply(np.ones((1, 3)))
    array([[3., 2., 2.]])
    """

    scale: float = 1.0
    rotation: Array = field(default_factory=_identity_rotation)
    translation: Array = field(default_factory=_zero_translation)

    def __post_init__(self) -> None:
        """Take float64 copies and refuse what is no similarity."""
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", np.array(self.rotation, dtype=np.float64))
        object.__setattr__(self, "translation", np.array(self.translation, dtype=np.float64))
        finite = np.isfinite(self.rotation).all() and np.isfinite(self.translation).all()
        if not (finite and np.isfinite(self.scale) and self.scale > 0):
            raise DegenerateGeometryError(
                f"a Sim(3) needs finite numbers and a positive scale, got scale {self.scale}"
            )
        orthonormal_rows = np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6)
        if not orthonormal_rows or np.linalg.det(self.rotation) < 0:
            raise DegenerateGeometryError("a Sim(3) needs an orthonormal rotation, no mirror")

    @classmethod
    def from_matrix(cls, matrix: Array) -> Sim3:
        """Read a (4, 4) matrix ``[s R, t; 0, 1]``."""
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        if not scale > 0:
            raise DegenerateGeometryError(f"a Sim(3) needs a positive scale, got {scale}")
        return cls(scale, matrix[:3, :3] / scale, matrix[:3, 3])

    def matrix(self) -> Array:
        """Return the (4, 4) matrix ``[s R, t; 0, 1]``."""
        out = np.eye(4)
        out[:3, :3] = self.scale * self.rotation
        out[:3, 3] = self.translation
        return out

    def inverse(self) -> Sim3:
        """Return ``a_from_b`` of this ``b_from_a``."""
        rotation = self.rotation.T
        return Sim3(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def __matmul__(self, other: Sim3) -> Sim3:
        """Compose: ``(c_from_b @ b_from_a)`` maps a to c."""
        return Sim3(
            self.scale * other.scale,
            orthonormal(self.rotation @ other.rotation),
            self.scale * (self.rotation @ other.translation) + self.translation,
        )

    def apply(self, points: Array) -> Array:
        """Map (..., 3) points."""
        return self.scale * (points @ self.rotation.T) + self.translation

    def apply_poses(self, source_from_cam: Array) -> Array:
        """Map (..., 4, 4) rigid camera poses; the results are rigid, in units of the target."""
        out = np.array(source_from_cam, dtype=np.float64)
        out[..., :3, :3] = self.rotation @ source_from_cam[..., :3, :3]
        out[..., :3, 3] = self.apply(source_from_cam[..., :3, 3])
        return out


def orthonormal(matrix: Array) -> Array:
    """Return the rotation nearest to (3, 3) ``matrix`` in Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    u[:, -1] *= np.sign(np.linalg.det(u @ vt))
    return np.asarray(u @ vt)


def rotation_log(rotation: Array) -> Array:
    """Return the rotation vectors (..., 3), in radians, of (..., 3, 3) rotations."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (import time of the command line)

    flat = Rotation.from_matrix(np.reshape(rotation, (-1, 3, 3))).as_rotvec()
    return np.asarray(flat.reshape(*rotation.shape[:-2], 3))


def rotation_exp(vector: Array) -> Array:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3) in radians."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    flat = Rotation.from_rotvec(np.reshape(vector, (-1, 3))).as_matrix()
    return np.asarray(flat.reshape(*vector.shape[:-1], 3, 3))


def umeyama(
    source: Array, target: Array, *, with_scale: bool = True, weights: Array | None = None
) -> Sim3:
    """Fit the similarity that maps ``source`` on ``target`` in the least-squares sense.

    Args:
        source: (N, 3) points.
        target: (N, 3) the same points in the other frame.
        with_scale: False fits a rigid motion (scale 1): the Kabsch algorithm.
        weights: (N,) >= 0, of each point's squared error; None: all alike.

    Returns:
        ``target_from_source``.

    Raises:
        DegenerateGeometryError: fewer than 3 points, or all of them in one place.

    Reference: Umeyama, PAMI 1991.
    """
    if len(source) < 3:
        raise DegenerateGeometryError(f"an alignment needs 3 points, got {len(source)}")
    share = np.ones(len(source)) if weights is None else weights
    share = share / share.sum()
    source_mean, target_mean = share @ source, share @ target
    source_c, target_c = source - source_mean, target - target_mean
    spread = float((share @ source_c**2).sum())
    if not np.isfinite(spread) or spread <= _rounding(source):
        raise DegenerateGeometryError("an alignment needs points in more than one place")
    if with_scale and float((share @ target_c**2).sum()) <= _rounding(target):
        raise DegenerateGeometryError("a scale needs target points in more than one place")
    u, singular, vt = np.linalg.svd(target_c.T @ (share[:, None] * source_c))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / spread) if with_scale else 1.0
    return Sim3(scale, rotation, target_mean - scale * rotation @ source_mean)


def _rounding(points: Array) -> float:
    """Return the squared spread that mere rounding gives points in one place."""
    return float((1e-12 * np.abs(points).max()) ** 2)


def interpolate_poses(times_s: Array, key_times_s: Array, world_from_key: Array) -> Array:
    """Give every time a rigid pose: linear centre, spherical rotation; held beyond the ends.

    Args:
        times_s: (M,) seconds.
        key_times_s: (N,) strictly rising seconds of the known poses, N >= 1.
        world_from_key: (N, 4, 4) rigid.

    Returns:
        (M, 4, 4) ``world_from_cam``; a known pose comes back unchanged.
    """
    from scipy.spatial.transform import Rotation, Slerp  # noqa: PLC0415

    clipped = np.clip(times_s, key_times_s[0], key_times_s[-1])
    out = np.tile(np.eye(4), (len(times_s), 1, 1))
    if len(key_times_s) == 1:
        out[:] = world_from_key[0]
        return out
    slerp = Slerp(key_times_s, Rotation.from_matrix(world_from_key[:, :3, :3]))
    out[:, :3, :3] = slerp(clipped).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(clipped, key_times_s, world_from_key[:, axis, 3])
    return out


def interpolate_sim3(first: Sim3, second: Sim3, shares: Array) -> list[Sim3]:
    """Go from one similarity to another at a constant rate of turning, growing and moving.

    The way does not depend on the choice of either frame.

    Args:
        first: where share 0 is.
        second: where share 1 is; a rotation by less than half a turn away.
        shares: (M,) how far along the way.
    """
    step = first.inverse() @ second
    turn, growth = rotation_log(step.rotation), float(np.log(step.scale))
    drift = np.linalg.solve(_mean_motion(turn[None], np.array([growth]))[0], step.translation)
    turns, growths = shares[:, None] * turn, shares * growth
    moves = shares[:, None] * (_mean_motion(turns, growths) @ drift)
    rotations = rotation_exp(turns)
    return [first @ Sim3(*part) for part in zip(np.exp(growths), rotations, moves, strict=True)]


def _mean_motion(turns: Array, growths: Array) -> Array:
    """Return the (M, 3, 3) means of scaled rotations on the way to (M, 3) turns and (M,) growths.

    Gauss's quadrature is exact to rounding for up to half a turn, and knows no small angle.
    """
    nodes, weights = np.polynomial.legendre.leggauss(16)
    parts = (nodes + 1) / 2
    rotations = rotation_exp(parts[:, None] * turns[:, None, :])
    shares = weights / 2 * np.exp(parts * growths[:, None])
    return np.asarray((shares[..., None, None] * rotations).sum(axis=1))


def complete_poses(frames: NDArray[np.int64], known: NDArray[np.int64], poses: Array) -> Array:
    """Give every frame a pose: interpolated between known ones, beyond them at their last speed.

    Args:
        frames: (M,) rising indices.
        known: (N,) rising indices of the frames whose pose is known, N >= 1.
        poses: (N, 4, 4) rigid world_from_cam.

    Returns:
        (M, 4, 4) rigid world_from_cam; a known pose comes back unchanged.
    """
    out = interpolate_poses(frames.astype(np.float64), known.astype(np.float64), poses)
    after, before = np.flatnonzero(frames > known[-1]), np.flatnonzero(frames < known[0])[::-1]
    _continue(out, after, frames, known[::-1], poses[::-1])
    _continue(out, before, frames, known, poses)
    return out


def _continue(
    out: Array,
    beyond: NDArray[np.int64],
    frames: NDArray[np.int64],
    known: NDArray[np.int64],
    poses: Array,
) -> None:
    """Fill the poses ``beyond`` an end, outwards; ``known`` and ``poses`` start at that end."""
    frame, pose = int(known[0]), poses[0]
    turn, move = _velocity(known[: STEPS_OF_VELOCITY + 1], poses[: STEPS_OF_VELOCITY + 1])
    for i in beyond:
        gap = int(frames[i]) - frame
        step = np.eye(4)
        step[:3, :3] = rotation_exp(gap * turn)
        step[:3, 3] = gap * move
        frame, pose = int(frames[i]), pose @ step
        out[i] = pose


def _velocity(frames: NDArray[np.int64], poses: Array) -> tuple[Array, Array]:
    """Return the mean rotation vector and translation per frame, in camera axes."""
    gaps = np.diff(frames)[:, None]
    if not len(gaps):
        return np.zeros(3), np.zeros(3)
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    return (rotation_log(steps[:, :3, :3]) / gaps).mean(axis=0), (steps[:, :3, 3] / gaps).mean(
        axis=0
    )


def cross_matrix(vectors: Array) -> Array:
    """Return the (..., 3, 3) matrices of the cross product with (..., 3) vectors."""
    out = np.zeros((*vectors.shape, 3))
    for row, col, axis, sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
        out[..., row, col] = sign * vectors[..., axis]
        out[..., col, row] = -out[..., row, col]
    return out
