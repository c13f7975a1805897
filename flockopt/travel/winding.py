"""Compiled: where a taut string between two points bends around a round core: a line that it keeps so far from, or a centre.

Seen along the core, the string is tangent to a circle on both sides and bends where the two tangents meet; unrolled, it is
straight. So one bend is known in closed form, and so are the places of all bends along parallel cores.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.geometry.kernels import segment_length
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import Features

__all__ = ["LOOSE", "NOT_ROUND", "WOUND", "heights_along", "run_end", "wound"]

#: What `wound` finds: a bend, none needed there, or that there is no circle to wind around.
WOUND, LOOSE, NOT_ROUND = 0, 1, 2

#: Most that a string turns at one bend, radians: beyond, its bend would stand far out.
MOST_TURN = 2.6
#: What two parallel directions' cosine is at least.
PARALLEL = 1.0 - 1e-9
#: Columns of a gate: how far across the edges it is, metres; where along them the bend is now; between where and where it may
#: be; and whether its own edge runs the same way as the first one.
ACROSS, NOW, LOW, HIGH, SENSE = 0, 1, 2, 3, 4
#: What two gates are apart at least, for slopes, metres.
LEAST_ACROSS_M = 1e-9
#: What an area that tells a plane is at least, as a share of the room squared.
LEAST_PLANE = 1e-6
#: By what share more than it must a bend keeps from the core, against rounding.
ROUNDING = 1e-12


@compiled_lazily(error_model="numpy")
def wound(features: Features, f: int, before: FloatArray, at: FloatArray, after: FloatArray, bend: FloatArray) -> int:
    """Fill ``bend`` (3,) m with where the string from ``before`` to ``after`` bends around the core of feature ``f``.

    Args:
        features: All features.
        f: Which of them; ``at``, where the string bends now, says on which side of it the string is.
        before: (3,) m.
        at: (3,) m.
        after: (3,) m.
        bend: (3,) m, filled if the answer is `WOUND`; on the free stretch of the feature's edge.

    Returns:
        `WOUND`, `LOOSE` or `NOT_ROUND`.
    """
    room = features.room[f] * (1.0 + ROUNDING)
    if room <= 0.0:
        return NOT_ROUND
    core, e = features.core[f], features.along[f]
    e0, e1, e2 = e[0], e[1], e[2]
    a0, a1, a2 = before[0] - core[0], before[1] - core[1], before[2] - core[2]
    b0, b1, b2 = after[0] - core[0], after[1] - core[1], after[2] - core[2]
    if e0 == 0.0 and e1 == 0.0 and e2 == 0.0:  # a sphere: in the plane of its centre and both points
        e0, e1, e2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        size = math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
        if size <= LEAST_PLANE * room * room:  # all three on one line: in the plane that the string is in now
            c0, c1, c2 = at[0] - core[0], at[1] - core[1], at[2] - core[2]
            e0, e1, e2 = a1 * c2 - a2 * c1, a2 * c0 - a0 * c2, a0 * c1 - a1 * c0
            size = math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
        if size <= 0.0:
            return NOT_ROUND
        e0, e1, e2 = e0 / size, e1 / size, e2 / size
    along_a, along_b = a0 * e0 + a1 * e1 + a2 * e2, b0 * e0 + b1 * e1 + b2 * e2
    a0, a1, a2 = a0 - along_a * e0, a1 - along_a * e1, a2 - along_a * e2
    b0, b1, b2 = b0 - along_b * e0, b1 - along_b * e1, b2 - along_b * e2
    away_a, away_b = math.sqrt(a0 * a0 + a1 * a1 + a2 * a2), math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
    if away_a <= room or away_b <= room:
        return NOT_ROUND
    # in one piece, as one reads a construction: u points to `before`, v a quarter turn on; angles are measured from u, towards
    # the side where the string is now
    u0, u1, u2 = a0 / away_a, a1 / away_a, a2 / away_a
    v0, v1, v2 = e1 * u2 - e2 * u1, e2 * u0 - e0 * u2, e0 * u1 - e1 * u0
    c0, c1, c2 = at[0] - core[0], at[1] - core[1], at[2] - core[2]
    angle = math.atan2(b0 * v0 + b1 * v1 + b2 * v2, b0 * u0 + b1 * u1 + b2 * u2)
    side = math.atan2(c0 * v0 + c1 * v1 + c2 * v2, c0 * u0 + c1 * u1 + c2 * u2)
    angle, side = (angle if angle >= 0.0 else angle + 2.0 * math.pi), (side if side >= 0.0 else side + 2.0 * math.pi)
    turned = 1.0
    if side > angle:
        turned, angle = -1.0, 2.0 * math.pi - angle
    leave = math.acos(room / away_a)
    half = 0.5 * (angle - leave - math.acos(room / away_b))
    if half <= 0.0:
        return LOOSE
    if 2.0 * half > MOST_TURN:
        return NOT_ROUND
    out, over = room / math.cos(half), room * math.tan(half)
    x, y = out * math.cos(leave + half), turned * out * math.sin(leave + half)
    first, second = math.sqrt(away_a * away_a - room * room) + over, math.sqrt(away_b * away_b - room * room) + over
    s = along_a + (along_b - along_a) * first / (first + second)
    if features.along[f, 0] != 0.0 or features.along[f, 1] != 0.0 or features.along[f, 2] != 0.0:
        beside = 0.0
        for axis in range(3):
            beside += (features.position[f, axis] - core[axis]) * e[axis]
        s = min(max(s, beside + features.back[f]), beside + features.onward[f])
    bend[0] = core[0] + x * u0 + y * v0 + s * e0
    bend[1] = core[1] + x * u1 + y * v1 + s * e1
    bend[2] = core[2] + x * u2 + y * v2 + s * e2
    return WOUND


@compiled_lazily(error_model="numpy")
def run_end(features: Features, chain: NDArray[np.int64], first: int, size: int) -> int:
    """The last of the bends after ``first`` (of a path of ``size`` vertices) that are around cores parallel to its own."""
    e, last = features.along[chain[first]], first
    while last + 1 < size - 1:
        f = chain[last + 1]
        cosine = e[0] * features.along[f, 0] + e[1] * features.along[f, 1] + e[2] * features.along[f, 2]
        if abs(cosine) < PARALLEL:
            break
        last += 1
    return last


@compiled_lazily(error_model="numpy")
def heights_along(
    features: Features,
    chain: NDArray[np.int64],
    path: FloatArray,
    first: int,
    last: int,
    held: bool,
    gates: FloatArray,
    moves: FloatArray,
) -> bool:
    """Fill ``moves`` with how far bends ``first`` to ``last`` must move along their parallel edges for a shortest path.

    Unrolled about the edges, their free stretches are gates on a plane, and the shortest path is a string pulled taut through
    them: from gate to gate straight on, until one closes what the others leave open (Lee and Preparata 1984).

    Args:
        features: All features.
        chain: (V,) which of them each vertex is around.
        path: (V, 3) m.
        first: The first bend of the run.
        last: The last one.
        held: Whether bends are to be on the free stretches of their edges.
        gates: (V + 1, 5) for own use.
        moves: (V,) m, along each bend's own edge.

    Returns:
        Whether some bend is held where its free stretch ends.
    """
    is_held = False
    _fill_gates(features, chain, path, first, last, held, gates)
    here, height, k = 0.0, 0.0, first
    while k <= last:
        least, most, at_least, at_most, i = -np.inf, np.inf, k, k, k
        while i <= last + 1:
            ahead = max(gates[i, ACROSS] - here, LEAST_ACROSS_M)
            low, high = (gates[i, LOW] - height) / ahead, (gates[i, HIGH] - height) / ahead
            if low > most or high < least:
                break
            if low >= least:
                least, at_least = low, i
            if high <= most:
                most, at_most = high, i
            i += 1
        is_over = i <= last + 1 and low > most  # what comes is above what a gate before it leaves open
        is_under = i <= last + 1 and high < least
        stop = at_most if is_over else (at_least if is_under else last)
        slope = most if is_over else (least if is_under else (gates[last + 1, NOW] - height) / ahead)
        for gate in range(k, stop + 1):
            wanted = height + slope * (gates[gate, ACROSS] - here)
            moves[gate] = (min(max(wanted, gates[gate, LOW]), gates[gate, HIGH]) - gates[gate, NOW]) * gates[gate, SENSE]
        if is_over or is_under:
            is_held = True
            here, height = gates[stop, ACROSS], (gates[stop, HIGH] if is_over else gates[stop, LOW])
        k = stop + 1
    return is_held


@compiled_lazily(error_model="numpy")
def _fill_gates(
    features: Features, chain: NDArray[np.int64], path: FloatArray, first: int, last: int, held: bool, gates: FloatArray
) -> None:
    """Fill rows ``first`` to ``last + 1`` of ``gates``: see `ACROSS`; the last row is where the run leads to."""
    e, across, along = features.along[chain[first]], 0.0, 0.0
    for i in range(first, last + 2):
        step = 0.0
        for axis in range(3):
            step += (path[i, axis] - path[i - 1, axis]) * e[axis]
        length = segment_length(path[i - 1], path[i])
        across += math.sqrt(max(length * length - step * step, 0.0))
        along += step
        gate = gates[i]
        gate[ACROSS], gate[NOW], gate[LOW], gate[HIGH], gate[SENSE] = across, along, along, along, 1.0
        if i <= last:
            f, beside, same = chain[i], 0.0, 0.0
            for axis in range(3):
                beside += (features.position[f, axis] - path[i, axis]) * features.along[f, axis]
                same += e[axis] * features.along[f, axis]
            gate[SENSE] = 1.0 if same > 0.0 else -1.0
            if not held:
                gate[LOW], gate[HIGH] = -np.inf, np.inf
            elif same > 0.0:
                gate[LOW], gate[HIGH] = along + beside + features.back[f], along + beside + features.onward[f]
            else:
                gate[LOW], gate[HIGH] = along - beside - features.onward[f], along - beside - features.back[f]
