"""Connected regions of a mask as runs of pixels: cheap for sparse masks, without arrays of the image's size."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit


@njit(cache=True, nogil=True)
def label_runs(mask):  # type: ignore[no-untyped-def]
    """Runs of a mask's pixels, labeled by connected region (8-connectivity).

    Args:
        mask: Nonzero on the foreground. Shape (H, W), uint8, rows contiguous.

    Returns:
        Runs, one per row: row, first column, column after the last, index of the region; shape (n, 4), int32, in the
        order of the image; and the number of regions.
    """
    runs = _find_runs(mask)
    return runs, _number_regions(runs)


@njit(cache=True, nogil=True)
def label_again(runs):  # type: ignore[no-untyped-def]
    """Label runs that were shortened or removed, without a look at the image.

    Args:
        runs: Runs in the order of the image. Those with a negative index are left out. Shape (n, 4), int32.

    Returns:
        What `label_runs` returns for a mask of the same pixels.
    """
    count = 0
    for n in range(len(runs)):
        count += runs[n, 3] >= 0
    kept = np.empty((count, 4), np.int32)
    count = 0
    for n in range(len(runs)):
        if runs[n, 3] >= 0:
            for column in range(3):
                kept[count, column] = runs[n, column]
            count += 1
    return kept, _number_regions(kept)


@njit(cache=True, nogil=True)
def _find_runs(mask):  # type: ignore[no-untyped-def]
    """Runs in the order of the image; the column of the index is left empty."""
    height, width = mask.shape
    # Most of a mask is empty: eight pixels at once are skipped where rows are whole numbers of words.
    words = mask.view(np.uint64) if width % 8 == 0 else np.empty((height, 0), np.uint64)
    number = words.shape[1]
    most = np.zeros(height, np.int64)
    for row in range(height):
        if number:
            eights, some = words[row], 0
            for word in range(number):
                some += eights[word] != 0
            # At most every second pixel begins a run.
            most[row] = 4 * some
        else:
            line = mask[row]
            here = np.int64(line[0] != 0)
            # Without a branch or a dependence the compiler vectorizes this loop.
            for column in range(1, width):
                here += np.int64((line[column] != 0) & (line[column - 1] == 0))
            most[row] = here
    runs = np.empty((most.sum(), 4), np.int32)
    count = 0
    for row in range(height):
        if most[row] == 0:
            continue
        line, eights = mask[row], words[row]
        column = 0
        while column < width:
            if line[column] == 0:
                column += 1
                if number and column & 7 == 0:
                    word = column >> 3
                    while word < number and eights[word] == 0:
                        word += 1
                    column = word << 3
                continue
            first = column
            while column < width and line[column] != 0:
                column += 1
            runs[count, 0], runs[count, 1], runs[count, 2] = row, first, column
            count += 1
    return runs[:count]


@njit(cache=True, nogil=True)
def _number_regions(runs):  # type: ignore[no-untyped-def]
    """Write the index of the connected region of each run, in place; return the number of regions."""
    count = len(runs)
    parent = np.arange(count)
    above, row_start = 0, 0
    for n in range(count):
        row, first, stop = runs[n, 0], runs[n, 1], runs[n, 2]
        if runs[row_start, 0] != row:
            above, row_start = row_start, n
            if runs[above, 0] != row - 1:
                above = row_start
        while above < row_start and runs[above, 2] < first:
            above += 1
        touching = above
        while touching < row_start and runs[touching, 1] <= stop:
            a, b = _root(parent, n), _root(parent, touching)
            if a < b:
                parent[b] = a
            else:
                parent[a] = b
            touching += 1
    regions = 0
    for n in range(count):
        if parent[n] == n:
            runs[n, 3] = regions
            regions += 1
        else:
            # Roots come first, so they already have their index.
            runs[n, 3] = runs[_root(parent, n), 3]
    return regions


@njit(cache=True, nogil=True)
def _root(parent, n):  # type: ignore[no-untyped-def]
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@njit(cache=True, nogil=True)
def keep_regions(runs, keep):  # type: ignore[no-untyped-def]
    """Number the regions that are kept anew, in place; the index of runs of all others becomes -1.

    Args:
        runs: Result of `label_runs`; changed.
        keep: Mask of the regions. Shape (k,).
    """
    number = np.full(len(keep), -1, np.int32)
    count = 0
    for k in range(len(keep)):
        if keep[k]:
            number[k] = count
            count += 1
    for n in range(len(runs)):
        if runs[n, 3] >= 0:
            runs[n, 3] = number[runs[n, 3]]


@njit(cache=True, nogil=True)
def clear_removed(mask, runs):  # type: ignore[no-untyped-def]
    """Set the pixels of runs with a negative index to 0, in place.

    Args:
        mask: Foreground. Shape (H, W), uint8; changed.
        runs: Runs of the mask.
    """
    for n in range(len(runs)):
        if runs[n, 3] < 0:
            for column in range(runs[n, 1], runs[n, 2]):
                mask[runs[n, 0], column] = 0


@njit(cache=True, nogil=True)
def measure_runs(runs, regions):  # type: ignore[no-untyped-def]
    """Boxes, centroids and areas of regions.

    Args:
        runs: Result of `label_runs`; runs with a negative index belong to no region.
        regions: Number of regions k.

    Returns:
        Boxes (left, top, width, height), shape (k, 4); centroids, shape (k, 2); areas, shape (k,); all px, float64;
        pixel i spans i to i + 1. Zeros for a region without a pixel.
    """
    boxes, centroids, areas = np.zeros((regions, 4)), np.zeros((regions, 2)), np.zeros(regions)
    for n in range(runs.shape[0]):
        row, first, stop, k = runs[n, 0], runs[n, 1], runs[n, 2], runs[n, 3]
        if k < 0:
            continue
        length = stop - first
        if areas[k] == 0.0:
            boxes[k, 0], boxes[k, 1], boxes[k, 2] = first, row, stop
        boxes[k, 0] = min(boxes[k, 0], first)
        boxes[k, 1] = min(boxes[k, 1], row)
        boxes[k, 2] = max(boxes[k, 2], stop)
        boxes[k, 3] = max(boxes[k, 3], row + 1)
        centroids[k, 0] += length * (first + stop) / 2.0
        centroids[k, 1] += length * (row + 0.5)
        areas[k] += length
    for k in range(regions):
        boxes[k, 2] -= boxes[k, 0]
        boxes[k, 3] -= boxes[k, 1]
        if areas[k] > 0.0:
            # Entry by entry: division of a whole row compiles numba's broadcast errors, some 20 MB of code.
            centroids[k, 0] /= areas[k]
            centroids[k, 1] /= areas[k]
    return boxes, centroids, areas
