"""The camera's lens from pictures of a board: a joint fit of lens, board shape and all poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calib.board import Board, BoardView
from calib.copies import Independent, independent
from calib.errors import BlurredError, MisfitError, OneSidedError, TooFewError
from calib.lens import Lens, pose, project, rotation
from calib.plane import fit_homography, map_homography
from calib.robust import PriorKnowledge, RobustFit, robust_fit
from drivers.interfaces import FloatArray

#: Fewest pictures for a lens, and least tilt between two boards, rad.
LEAST_VIEWS, LEAST_TILT_RAD = 8, 0.25
#: Largest relative standard deviation of the focal length.
MOST_FOCAL_SPREAD = 0.01
#: Largest scatter of corners, px: more is blur, or a board that is not flat.
MOST_NOISE_PX = 0.5
#: Largest blur of edges, px: more biases the corners; standard deviation.
MOST_BLUR_PX = 2.5
#: Prior of any lens and board: standard deviations about 0.
_LENS_SPREAD = np.array([np.inf] * 4 + [1.0, 1.0, 0.01, 0.01, 1.0])
_WARP_SPREAD_M = 1e-3
#: Standard deviation of the ratio of a printer's lengths across and along its paper.
_STRETCH_SPREAD = 3e-3
#: Indices of the parameters: lens, bow of the board, stretch of the board, poses of 6 each.
_LENS, _WARP, _STRETCH, _POSES = slice(0, 9), slice(9, 11), 11, slice(12, None)
_GRID = (13, 10)


@dataclass(frozen=True, eq=False)
class ViewError:
    """Agreement of one picture with all others: corners, outliers among them, and rms misfit."""

    name: str
    corners: int
    outliers: int
    rms_px: float


@dataclass(frozen=True, eq=False)
class CameraFit:
    """Lens of a camera, with its uncertainty.

    covariance   (9, 9) of the lens' numbers
    warp_m       height of the board's middle above its left and right, upper and lower edges, m
    warp_std_m   their standard deviations
    stretch      relative stretch of the board across against upright; and its standard deviation
    halves_px    (R, C) distance of the two halves' lenses over the picture, after the best
                 homography: it shows errors of the model, which a covariance cannot
    spread_px    (R, C) standard deviation, over the picture, of a point's ideal pixel
    """

    lens: Lens
    covariance: FloatArray
    noise_px: float
    size_px: tuple[int, int]
    warp_m: tuple[float, float]
    warp_std_m: tuple[float, float]
    stretch: tuple[float, float]
    views: tuple[ViewError, ...]
    outliers: int
    halves_px: FloatArray
    spread_px: FloatArray


def fit_camera(views: Sequence[BoardView], board: Board) -> CameraFit:
    """Fit the lens to pictures of a board; pictures that show the same count as one.

    raises  TooFewError, OneSidedError, BlurredError, MisfitError
    """
    _check_blur(views)
    views = different_views(views).distinct
    if len(views) < LEAST_VIEWS:
        raise TooFewError(
            f"the board was found in {len(views)} of at least {LEAST_VIEWS} pictures that differ",
            "take more, 20 are good: the board in all corners, near and far, tilted to all sides",
        )
    sizes = {view.size_px for view in views}
    if len(sizes) > 1:
        raise MisfitError(f"pictures of different sizes: {sorted(sizes)}", "take them anew")
    size = views[0].size_px
    start, poses = _first_guess(views, board, size)
    _check_tilts(poses)
    fit = _fit(views, board, start, poses)
    mean, cov = fit.mean, fit.covariance
    lens = Lens.of(mean[:9])
    _check_fit(fit, lens)
    halves = [
        _fit(views[k::2], board, mean[_LENS], mean[_POSES].reshape(-1, 6)[k::2]).mean[_LENS]
        for k in (0, 1)
    ]
    _check_whole_picture([lens, *map(Lens.of, halves)], size)
    return CameraFit(
        lens,
        cov[:9, :9],
        fit.noise_px,
        size,
        (float(mean[9]), float(mean[10])),
        (float(np.sqrt(cov[9, 9])), float(np.sqrt(cov[10, 10]))),
        (float(mean[_STRETCH]), float(np.sqrt(cov[_STRETCH, _STRETCH]))),
        _per_view(views, fit),
        int(np.count_nonzero(~fit.used)),
        lens_difference(Lens.of(halves[0]), Lens.of(halves[1]), size),
        lens_spread(lens, cov[:9, :9], size),
    )


def different_views(views: Sequence[BoardView]) -> Independent[BoardView]:
    """Views without repetitions of the same place of the board."""
    return independent(views, lambda view: view.ids)


# --- the fit ----------------------------------------------------------------------------------


def _first_guess(
    views: Sequence[BoardView], board: Board, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """(9,) lens and (V, 6) poses by OpenCV."""
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    guess = np.array([[1.5 * size[0], 0, size[0] / 2], [0, 1.5 * size[0], size[1] / 2], [0, 0, 1]])
    try:
        _, K, distortion, turns, shifts = cv2.calibrateCamera(
            [board.corners_m[v.ids].astype(np.float32) for v in views],
            [v.pixels.astype(np.float32) for v in views],
            size,
            guess,
            np.zeros(5),
            flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K2,
        )
    except cv2.error as error:
        raise OneSidedError(
            "no lens explains these pictures", "show the board tilted to all sides"
        ) from error
    numbers = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion.ravel()[:5]])
    poses = np.array(
        [np.concatenate([t.ravel(), s.ravel()]) for t, s in zip(turns, shifts, strict=True)]
    )
    return numbers, poses


def _fit(
    views: Sequence[BoardView], board: Board, lens: FloatArray, poses: FloatArray
) -> RobustFit:
    """Joint fit of lens, bow, stretch and poses."""
    width, height = board.size_m
    points = [board.corners_m[v.ids] for v in views]
    bows = [1.0 - (2.0 * p[:, :2] / (width, height) - 1.0) ** 2 for p in points]
    observed = np.concatenate([v.pixels for v in views])
    ends = np.cumsum([len(p) for p in points])

    def model(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        residuals = np.empty_like(observed)
        slopes = np.zeros((len(observed), 2, len(x)))
        for k, (flat, bow, end) in enumerate(zip(points, bows, ends, strict=True)):
            rows = slice(end - len(flat), end)
            at = _POSES.start + 6 * k
            R, by_turn = rotation(x[at : at + 3])
            bent = flat * [1.0 + 0.5 * x[_STRETCH], 1.0 - 0.5 * x[_STRETCH], 1.0]
            bent[:, 2] += bow @ x[_WARP]
            pixels, by_point, by_lens = project(x[_LENS], bent @ R.T + x[at + 3 : at + 6])
            residuals[rows] = pixels - observed[rows]
            slopes[rows, :, _LENS] = by_lens
            slopes[rows, :, _WARP] = (by_point @ R[:, 2])[:, :, None] * bow[:, None, :]
            grown = flat * [0.5, -0.5, 0.0] @ R.T
            slopes[rows, :, _STRETCH] = np.einsum("nij,nj->ni", by_point, grown)
            slopes[rows, :, at : at + 3] = by_point @ np.einsum("ijk,nj->nik", by_turn, bent)
            slopes[rows, :, at + 3 : at + 6] = by_point
        return residuals, slopes

    start = np.concatenate([lens, [0.0, 0.0, 0.0], poses.ravel()])
    spread = np.concatenate(
        [_LENS_SPREAD, [_WARP_SPREAD_M] * 2, [_STRETCH_SPREAD], np.full(poses.size, np.inf)]
    )
    return robust_fit(model, start, PriorKnowledge.with_spread(np.zeros(len(start)), spread))


def _per_view(views: Sequence[BoardView], fit: RobustFit) -> tuple[ViewError, ...]:
    ends = np.cumsum([len(v.ids) for v in views])
    errors = []
    for view, end in zip(views, ends, strict=True):
        rows = slice(end - len(view.ids), end)
        residuals, used = fit.residuals[rows], fit.used[rows]
        rms = float(np.sqrt(np.mean(residuals[used] ** 2))) if used.any() else float("nan")
        errors.append(ViewError(view.name, len(view.ids), int(np.sum(~used)), rms))
    return tuple(errors)


# --- uncertainty ------------------------------------------------------------------------------


def picture_grid(size_px: tuple[int, int]) -> FloatArray:
    """(R, C, 2) pixels spread evenly over a picture, edges included."""
    columns, rows = _GRID
    u, v = np.meshgrid(
        np.linspace(0, size_px[0] - 1, columns), np.linspace(0, size_px[1] - 1, rows)
    )
    return np.stack([u, v], axis=-1)


def lens_difference(a: Lens, b: Lens, size_px: tuple[int, int]) -> FloatArray:
    """(R, C) px by which two lenses differ on a plane, after the best-fitting homography."""
    grid = picture_grid(size_px)
    first, second = a.ideal(grid).reshape(-1, 2), b.ideal(grid).reshape(-1, 2)
    off = map_homography(fit_homography(first, second), first) - second
    return np.asarray(np.linalg.norm(off, axis=1).reshape(grid.shape[:2]), dtype=np.float64)


def lens_spread(lens: Lens, covariance: FloatArray, size_px: tuple[int, int]) -> FloatArray:
    """(R, C) standard deviation, px, of a plane's points due to the lens, after a homography."""
    grid = picture_grid(size_px)
    ideal = lens.ideal(grid).reshape(-1, 2)
    scale = np.array([lens.fx_px, lens.fy_px])
    x = (ideal - [lens.cx_px, lens.cy_px]) / scale
    by_lens = np.empty((len(ideal), 2, 9))
    for k in range(9):
        step = np.zeros(9)
        step[k] = 1e-4 * max(1e-1, abs(lens.numbers[k]))
        ideals = [Lens.of(lens.numbers + s).ideal(grid).reshape(-1, 2) for s in (step, -step)]
        by_lens[:, :, k] = (ideals[0] - ideals[1]) / (2.0 * step[k])
    free = homography_tangents(x) * scale[None, :, None]
    flat, tangents = by_lens.reshape(-1, 9), free.reshape(-1, 8)
    basis, _ = np.linalg.qr(tangents)
    residual = flat - basis @ (basis.T @ flat)
    variance = np.einsum("np,pq,nq->n", residual, covariance, residual).reshape(-1, 2).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(grid.shape[:2]), dtype=np.float64)


def homography_tangents(points: FloatArray) -> FloatArray:
    """(N, 2, 8) derivatives of (N, 2) mapped points by a homography's numbers, at the identity."""
    x, y = points[:, 0], points[:, 1]
    zero, one = np.zeros(len(points)), np.ones(len(points))
    return np.stack(
        [
            np.stack([x, y, one, zero, zero, zero, -x * x, -x * y], axis=1),
            np.stack([zero, zero, zero, x, y, one, -x * y, -y * y], axis=1),
        ],
        axis=1,
    )


# --- refusals ---------------------------------------------------------------------------------


def _check_blur(views: Sequence[BoardView]) -> None:
    blurred = [v.name for v in views if v.blur_px > MOST_BLUR_PX]
    if len(blurred) > len(views) // 3:
        raise BlurredError(
            f"{len(blurred)} of {len(views)} pictures are blurred: {', '.join(blurred[:3])} …",
            "focus, stop the lens down, hold the board still, or shorten the exposure",
        )


def _check_tilts(poses: FloatArray) -> None:
    normals = np.array([pose(p)[:3, 2] for p in poses])
    angles = np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
    if angles.max() < LEAST_TILT_RAD:
        raise OneSidedError(
            f"the board was tilted by {np.degrees(angles.max()):.0f}° at most between pictures, "
            f"{np.degrees(LEAST_TILT_RAD):.0f}° are needed",
            "tilt it 30° to each of its four sides as well",
        )


def _check_fit(fit: RobustFit, lens: Lens) -> None:
    focal = np.array([lens.fx_px, lens.fy_px])
    spread = np.sqrt(np.diag(fit.covariance)[:2]) / np.abs(focal)
    if spread.max() > MOST_FOCAL_SPREAD:
        raise OneSidedError(
            f"the focal length stays uncertain by {spread.max():.1%}, allowed "
            f"{MOST_FOCAL_SPREAD:.0%}",
            "add pictures with the board tilted 30° to each of its four sides, near and far",
        )
    if fit.noise_px > MOST_NOISE_PX:
        raise MisfitError(
            f"corners are {fit.noise_px:.2f} px rms from where they must be, allowed "
            f"{MOST_NOISE_PX} px",
            "check that the board is flat and stiff, its description, focus and shutter",
        )


def _check_whole_picture(lenses: Sequence[Lens], size_px: tuple[int, int]) -> None:
    """Raises OneSidedError: at the picture's edges a lens has no ideal point for a pixel."""
    open_there = np.isnan([lens.ideal(picture_grid(size_px)) for lens in lenses]).any(axis=(0, 3))
    if np.any(open_there):
        raise OneSidedError(
            f"in {np.mean(open_there):.0%} of the picture the lens stays unknown",
            "show the board in all corners of the picture, up to its edges",
        )
