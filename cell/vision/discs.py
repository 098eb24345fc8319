"""Light discs in a picture, and the rigid body that they are fixed to.  Compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.lens import distorted, undistorted
from cell.cable.arrays import FloatArray
from cell.vision.compiling import compiled, hypot, inline, part

_distorted, _undistorted = part(distorted), part(undistorted)

_MOST = 512  # discs in one picture; further ones are ignored
_SURROUNDINGS = 2.5  # of a disc, in its radii
_LIGHTER = 15  # than their surroundings, grey levels
_ROUNDS = 3  # of a centre: after two it still depends on its start by 1e-6 px


class Marks(NamedTuple):
    """Discs of one body: (M, 2) centres in its frame, radius and tolerance, m."""

    centres_m: FloatArray
    radius_m: float
    tolerance_m: float


class ImageView(NamedTuple):
    """Mapping from pixels to the plane and back; see `PlaneView`.

    maps     (2, 3, 3) homography from homogeneous ideal pixels to the plane in metres, and back
    lens     (9,) numbers of the lens model
    distorts whether the lens distorts
    """

    maps: FloatArray
    lens: FloatArray
    distorts: bool


class DiscMemory(NamedTuple):
    """Memory for pictures of one size.

    coarse, light  (H, W) block means, and which of them are lighter than their surroundings
    sums, stack    (W,) sums down columns; (H W,) pixels of a blob still to visit
    centres        (512, 2) of discs, in the plane
    nearest, pair  (M,) disc nearest to each mark, −1 = none; disc of each mark of a tried pair
    """

    coarse: NDArray[np.uint8]
    light: NDArray[np.uint8]
    sums: NDArray[np.int32]
    stack: NDArray[np.int32]
    centres: FloatArray
    nearest: NDArray[np.int64]
    pair: NDArray[np.int64]


class BodyPose(NamedTuple):
    """Place and angle of the body's frame in the plane, marks used (0 = no body), rms misfit."""

    x_m: float
    y_m: float
    angle_rad: float
    marks: int
    rms_m: float


def disc_memory(shape: tuple[int, int], marks: int) -> DiscMemory:
    """See `DiscMemory`; for pictures (H, W) and a number of marks."""
    height, width = shape
    return DiscMemory(
        coarse=np.empty(shape, np.uint8),
        light=np.empty(shape, np.uint8),
        sums=np.empty(width, np.int32),
        stack=np.empty(height * width, np.int32),
        centres=np.empty((_MOST, 2)),
        nearest=np.empty(marks, np.int64),
        pair=np.empty(marks, np.int64),
    )


@inline
def _mapped(maps, which, u, v):  # type: ignore[no-untyped-def]
    w = u * maps[which, 2, 0] + v * maps[which, 2, 1] + maps[which, 2, 2]
    return (
        (u * maps[which, 0, 0] + v * maps[which, 0, 1] + maps[which, 0, 2]) / w,
        (u * maps[which, 1, 0] + v * maps[which, 1, 1] + maps[which, 1, 2]) / w,
    )


@part
def to_plane(view, u, v):  # type: ignore[no-untyped-def]
    """Place in the plane, m, of a pixel (column, row)."""
    if view.distorts:
        u, v = _undistorted(view.lens, u, v)
    return _mapped(view.maps, 0, u, v)


@part
def to_pixels(view, x, y):  # type: ignore[no-untyped-def]
    """Pixel (column, row) of a place in the plane, m."""
    u, v = _mapped(view.maps, 1, x, y)
    if view.distorts:
        u, v = _distorted(view.lens, u, v)
    return u, v


@inline
def scale_at(view, u, v):  # type: ignore[no-untyped-def]
    """Local scale of a view at a pixel, px/m."""
    x, y = to_plane(view, u, v)
    ax, ay = to_plane(view, u + 1.0, v)
    bx, by = to_plane(view, u, v + 1.0)
    return 1.0 / np.sqrt(abs((ax - x) * (by - y) - (ay - y) * (bx - x)))


@part
def find_body(image, view, marks, memory, previous, reach):  # type: ignore[no-untyped-def]
    """`BodyPose` of a body by its marks; it does not depend on `previous`.

    previous  earlier place and angle, around which the search starts; place nan = search the full
             picture, angle nan = it may have turned
    reach    largest displacement of a mark since then, m
    source   Kabsch 1976 (rigid fit)
    """
    height, width = image.shape
    usual = marks.radius_m * scale_at(view, 0.5 * width, 0.5 * height)
    shrink = max(1, int(usual // 3.0))
    half = int(np.ceil(_SURROUNDINGS * usual / shrink))
    blocks = (shrink, half)
    if np.isfinite(previous[0]) and np.isfinite(previous[1]):
        left, top, right, bottom = _around(view, marks, previous, reach)
        beyond = (half + 1) * shrink  # the marks' surroundings are needed, too
        left, right = min(max(left - beyond, 0), width), min(max(right + beyond, 0), width)
        top, bottom = min(max(top - beyond, 0), height), min(max(bottom + beyond, 0), height)
        left, top = left - left % shrink, top - top % shrink  # multiples of a block
        right = min(-(-right // shrink) * shrink, width)
        bottom = min(-(-bottom // shrink) * shrink, height)
        if right - left > 8 and bottom - top > 8:
            pose = _find(image, (left, top, right, bottom), blocks, view, marks, memory)
            # else one may have left the box
            if pose.marks == len(marks.centres_m) and _moved(previous, pose, marks) < reach:
                return pose
    return _find(image, (0, 0, width, height), blocks, view, marks, memory)


@part
def _moved(near, pose, marks):  # type: ignore[no-untyped-def]
    """Largest displacement of a mark, m; that of the origin if the body may have turned."""
    x, y, angle = near
    furthest = hypot(pose.x_m - x, pose.y_m - y)
    if not np.isnan(angle):
        dc = np.cos(pose.angle_rad) - np.cos(angle)
        ds = np.sin(pose.angle_rad) - np.sin(angle)
        for m in range(len(marks.centres_m)):
            along, up = marks.centres_m[m]
            dx = pose.x_m - x + dc * along - ds * up
            dy = pose.y_m - y + ds * along + dc * up
            furthest = max(furthest, hypot(dx, dy))
    return furthest


@compiled
def body_values(image, view, marks, memory, previous, reach):  # type: ignore[no-untyped-def]
    """The values of `find_body`'s result as a plain tuple; see `detect.frame_values`."""
    pose = find_body(image, view, marks, memory, previous, reach)
    return pose.x_m, pose.y_m, pose.angle_rad, pose.marks, pose.rms_m


@part
def _around(view, marks, near, reach):  # type: ignore[no-untyped-def]
    """Left, top, right, bottom of the pixels in which the marks can be."""
    x, y, angle = near
    centres, count = marks.centres_m, len(marks.centres_m)
    half = reach + marks.radius_m
    if np.isnan(angle):
        count = 1
        for m in range(len(centres)):
            half = max(half, reach + marks.radius_m + abs(centres[m, 0]))
            half = max(half, reach + marks.radius_m + abs(centres[m, 1]))
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    for m in range(count):
        px, py = x, y
        if not np.isnan(angle):
            c, s = np.cos(angle), np.sin(angle)
            px += c * centres[m, 0] - s * centres[m, 1]
            py += s * centres[m, 0] + c * centres[m, 1]
        for sx in (-half, half):
            for sy in (-half, half):
                u, v = to_pixels(view, px + sx, py + sy)
                left, right = min(left, u), max(right, u)
                top, bottom = min(top, v), max(bottom, v)
    far = 1e6
    return (
        int(np.floor(max(left, -far))),
        int(np.floor(max(top, -far))),
        int(np.ceil(min(right, far))),
        int(np.ceil(min(bottom, far))),
    )


@part
def _find(image, box, blocks, view, marks, memory):  # type: ignore[no-untyped-def]
    """`BodyPose` from a box (left, top, right, bottom) of a picture.

    blocks  pixels per block of the coarse picture, and blocks on each side of a disc's surroundings
    """
    left, top, right, bottom = box
    shrink, half = blocks
    part = image[top:bottom, left:right]
    coarse = memory.coarse[: part.shape[0] // shrink, : part.shape[1] // shrink]
    light = memory.light[: coarse.shape[0], : coarse.shape[1]]
    if coarse.size == 0:
        return BodyPose(np.nan, np.nan, np.nan, 0, np.nan)
    _block_means(part, shrink, memory.sums, coarse)
    _lighter(coarse, half, memory.sums, light)
    count = _discs(image, light, shrink, (left // shrink, top // shrink), view, marks, memory)
    for n in range(count):
        u, v = memory.centres[n, 0], memory.centres[n, 1]
        memory.centres[n, 0], memory.centres[n, 1] = to_plane(view, u, v)
    return _rigid_match(memory.centres[:count], marks, memory)


@part
def _block_means(part, shrink, sums, coarse):  # type: ignore[no-untyped-def]
    """Means of blocks of shrink × shrink pixels; halves are rounded to even, up for 2 × 2 blocks.

    This is OpenCV's rounding (`INTER_AREA`): half a grey level at a disc's edge decides where the
    search for its centre starts.
    """
    rows, columns = coarse.shape
    wide = columns * shrink
    size = shrink * shrink
    for r in range(rows):
        for c in range(wide):
            sums[c] = 0
        for k in range(shrink):
            row = part[r * shrink + k]
            for c in range(wide):
                sums[c] += row[c]
        for c in range(columns):
            total = 0
            for k in range(shrink):
                total += sums[c * shrink + k]
            level, beyond = total // size, 2 * (total % size) - size
            up = beyond > 0 or (beyond == 0 and (level % 2 == 1 or shrink == 2))
            coarse[r, c] = level + up


@part
def _lighter(coarse, half, sums, light):  # type: ignore[no-untyped-def]
    """Flags of pixels lighter than the mean of the square of ± half around, edges repeated."""
    rows, columns = coarse.shape
    size = (2 * half + 1) ** 2
    for c in range(columns):
        sums[c] = (half + 1) * coarse[0, c]
        for r in range(half):
            sums[c] += coarse[min(r, rows - 1), c]
    for r in range(rows):
        entering, leaving = coarse[min(r + half, rows - 1)], coarse[max(r - half - 1, 0)]
        for c in range(columns):
            sums[c] += np.int32(entering[c]) - np.int32(leaving[c])
        total = (half + 1) * sums[0]
        for c in range(half):
            total += sums[min(c, columns - 1)]
        for c in range(columns):
            total += sums[min(c + half, columns - 1)] - sums[max(c - half - 1, 0)]
            mean = (2 * total + size) // (2 * size)
            light[r, c] = coarse[r, c] - mean > _LIGHTER


@part
def _discs(image, light, shrink, corner, view, marks, memory):  # type: ignore[no-untyped-def]
    """Number of discs of about the marks' radius; their centres, in pixels, into memory.

    corner  column and row of the first block of `light` in the picture
    """
    rows, columns = light.shape
    stack, count = memory.stack, 0
    for row in range(rows):
        for column in range(columns):
            if not light[row, column]:
                continue
            light[row, column] = 0
            stack[0], waiting = row * columns + column, 1
            size, down, along = 0, 0.0, 0.0
            left, right, top, bottom = column, column, row, row
            while waiting:
                waiting -= 1
                j, i = stack[waiting] // columns, stack[waiting] % columns
                size += 1
                down += j + corner[1]
                along += i + corner[0]
                left, right, top, bottom = min(left, i), max(right, i), min(top, j), max(bottom, j)
                for dj, di in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                    y, x = j + dj, i + di
                    if 0 <= y < rows and 0 <= x < columns and light[y, x]:
                        light[y, x] = 0
                        stack[waiting] = y * columns + x
                        waiting += 1
            wide = max(right - left, bottom - top) + 1
            u = (along / size + 0.5) * shrink - 0.5
            v = (down / size + 0.5) * shrink - 0.5
            radius = marks.radius_m * scale_at(view, u, v)
            r, area = radius / shrink, np.pi * (radius / shrink) ** 2
            if 0.4 * area < size < 2.2 * area and wide < 3.2 * r and count < _MOST:
                u, v = _centroid(image, u, v, radius)
                if not np.isnan(u):
                    memory.centres[count, 0], memory.centres[count, 1] = u, v
                    count += 1
    return count


@part
def _centroid(image, column, row, radius):  # type: ignore[no-untyped-def]
    """Centroid (column, row) by grey levels between inside and surroundings; nan = no disc."""
    height, width = image.shape
    half = int(np.ceil(1.6 * radius))
    core, inner, outer = (0.5 * radius) ** 2, (1.25 * radius) ** 2, (1.55 * radius) ** 2
    counted = (1.45 * radius) ** 2
    for _ in range(_ROUNDS):
        left, top = int(np.rint(column)), int(np.rint(row))
        if not (half <= left < width - half and half <= top < height - half):
            return np.nan, np.nan
        inside, around, insiders, outsiders = 0.0, 0.0, 0, 0
        for v in range(-half, half + 1):
            down = (v - (row - top)) ** 2
            for u in range(-half, half + 1):
                distance = (u - (column - left)) ** 2 + down
                level = image[top + v, left + u]
                if distance < core:
                    inside += level
                    insiders += 1
                elif inner < distance < outer:
                    around += level
                    outsiders += 1
        inside /= insiders
        around /= outsiders
        if inside - around < 30.0:
            return np.nan, np.nan
        total, along, deep = 0.0, 0.0, 0.0
        share_per_level = 1.0 / (inside - around)
        for v in range(-half, half + 1):
            down = (v - (row - top)) ** 2
            for u in range(-half, half + 1):
                if (u - (column - left)) ** 2 + down > counted:
                    continue
                share = (image[top + v, left + u] - around) * share_per_level
                share = min(max(share, 0.0), 1.0)
                total += share
                along += share * u
                deep += share * v
        if not 0.7 < total / (np.pi * radius * radius) < 1.4:
            return np.nan, np.nan
        column, row = left + along / total, top + deep / total
    return column, row


@part
def _rigid_match(points, marks, memory):  # type: ignore[no-untyped-def]
    """Best rigid fit of the marks to (N, 2) points in the plane; it needs at least 3 inliers."""
    centres, tolerance = marks.centres_m, marks.tolerance_m
    best = BodyPose(np.nan, np.nan, np.nan, 0, np.nan)
    for a in range(len(centres)):
        for b in range(a + 1, len(centres)):
            distance = hypot(centres[b, 0] - centres[a, 0], centres[b, 1] - centres[a, 1])
            for i in range(len(points)):
                for j in range(len(points)):
                    apart = hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
                    if not abs(apart - distance) < tolerance:
                        continue
                    for m in range(len(centres)):
                        memory.pair[m] = -1
                    memory.pair[a], memory.pair[b] = i, j
                    pose = _rigid_fit(centres, points, memory.pair)
                    used = _nearest(centres, points, pose, 2.0 * tolerance, memory.nearest)
                    if used < 3 or used < best.marks:
                        continue
                    pose = _rigid_fit(centres, points, memory.nearest)
                    if pose.rms_m < tolerance and (used > best.marks or pose.rms_m < best.rms_m):
                        best = pose
                        if used == len(centres):
                            return best
    return best


@part
def _nearest(centres, points, pose, most, nearest):  # type: ignore[no-untyped-def]
    """Points nearest to the marks of a body at a pose, −1 where further than `most`, m.

    returns  number of marks with a point; 0 if two have the same
    """
    c, s = np.cos(pose.angle_rad), np.sin(pose.angle_rad)
    used = 0
    for m in range(len(centres)):
        x = pose.x_m + c * centres[m, 0] - s * centres[m, 1]
        y = pose.y_m + s * centres[m, 0] + c * centres[m, 1]
        least, nearest[m] = most, -1
        for n in range(len(points)):
            off = hypot(points[n, 0] - x, points[n, 1] - y)
            if off < least:
                least, nearest[m] = off, n
        if nearest[m] >= 0:
            used += 1
            for other in range(m):
                if nearest[other] == nearest[m]:
                    return 0
    return used


@part
def _rigid_fit(centres, points, nearest):  # type: ignore[no-untyped-def]
    """`BodyPose` that brings the marks to their points (`nearest`, −1 = none), least squares."""
    used = 0
    mx, my, px, py = 0.0, 0.0, 0.0, 0.0
    for m in range(len(centres)):
        if nearest[m] >= 0:
            used += 1
            mx += centres[m, 0]
            my += centres[m, 1]
            px += points[nearest[m], 0]
            py += points[nearest[m], 1]
    mx, my, px, py = mx / used, my / used, px / used, py / used
    sine, cosine = 0.0, 0.0
    for m in range(len(centres)):
        if nearest[m] >= 0:
            ax, ay = centres[m, 0] - mx, centres[m, 1] - my
            bx, by = points[nearest[m], 0] - px, points[nearest[m], 1] - py
            sine += ax * by - ay * bx
            cosine += ax * bx + ay * by
    angle = np.arctan2(sine, cosine)
    c, s = np.cos(angle), np.sin(angle)
    x, y = px - (c * mx - s * my), py - (s * mx + c * my)
    squares = 0.0
    for m in range(len(centres)):
        if nearest[m] >= 0:
            ex = x + c * centres[m, 0] - s * centres[m, 1] - points[nearest[m], 0]
            ey = y + s * centres[m, 0] + c * centres[m, 1] - points[nearest[m], 1]
            squares += ex * ex + ey * ey
    return BodyPose(x, y, angle, used, np.sqrt(squares / used))
