"""KITTI's odometry metric in plain Python, line by line after the formula of its development kit: slow, and nobody's import.

Poses are lists of lists. Only the double precision differs from the kit, which keeps distances in float32.
"""

from __future__ import annotations

import itertools
import math

Matrix = list[list[float]]
LENGTHS = [100, 200, 300, 400, 500, 600, 700, 800]


def multiply(a: Matrix, b: Matrix) -> Matrix:
    return [[sum(a[i][k] * b[k][j] for k in range(4)) for j in range(4)] for i in range(4)]


def invert(a: Matrix) -> Matrix:
    """Gauss-Jordan with pivots, as the kit's `Matrix::inv`."""
    work = [[*row, *[1.0 if i == j else 0.0 for j in range(4)]] for i, row in enumerate(a)]
    for column in range(4):
        pivot = max(range(column, 4), key=lambda row: abs(work[row][column]))
        work[column], work[pivot] = work[pivot], work[column]
        scale = work[column][column]
        work[column] = [value / scale for value in work[column]]
        for row in range(4):
            if row != column:
                factor = work[row][column]
                work[row] = [x - factor * y for x, y in zip(work[row], work[column], strict=True)]
    return [row[4:] for row in work]


def drift(estimate: list[Matrix], truth: list[Matrix]) -> tuple[float, float, int]:
    """Translation %, rotation deg/100 m and the number of segments."""
    distance = [0.0]
    for a, b in itertools.pairwise(truth):
        distance.append(distance[-1] + math.sqrt(sum((a[k][3] - b[k][3]) ** 2 for k in range(3))))
    translations, rotations = [], []
    for first in range(0, len(truth), 10):
        for length in LENGTHS:
            last = next((i for i in range(first, len(distance)) if distance[i] > distance[first] + length), -1)
            if last == -1:
                continue
            motion_gt = multiply(invert(truth[first]), truth[last])
            motion = multiply(invert(estimate[first]), estimate[last])
            error = multiply(invert(motion), motion_gt)
            cosine = 0.5 * (error[0][0] + error[1][1] + error[2][2] - 1.0)
            rotations.append(math.acos(max(min(cosine, 1.0), -1.0)) / length)
            translations.append(math.sqrt(sum(error[k][3] ** 2 for k in range(3))) / length)
    n = len(translations)
    return 100 * sum(translations) / n, math.degrees(sum(rotations) / n) * 100, n
