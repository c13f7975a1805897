"""Compiled forest bounds: a spanning tree of the tasks grown from one super-root, legs to ends, and their Held-Karp ascent.

Drop from an allocation everything but its connectedness: every task hangs by some chain of tasks from some
start. Such a forest is a spanning tree of the tasks and one super-root that stands for all starts, so the
cheapest spanning tree bounds what routes travel before their ends. A route also ends once, at some task; every task has two
legs; a drone flies as many first legs as last ones, one or none; and so many drones fly as can carry all tasks. Prices on
breaking these rules (Held and Karp 1970) lift the bound.
"""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLAGS_1, FLOATS_1, FLOATS_2, INTEGERS_1, compiled_for, compiled_lazily, writable
from flockopt.bundles.bounds.polyak import BEST, LEAST_REACH, aim
from flockopt.records.arrays import FloatArray

__all__ = ["ascend", "relax"]

#: Share of the new direction in a step; the rest is the last direction, which damps the zigzag.
DIRECTION_SHARE = 0.7

#: What the reach of the steps shrinks to.
COOLING = 0.5


@compiled_for(FLOATS_2, FLOATS_1, writable(FLOATS_1), writable(INTEGERS_1))
def _roots(starts: FloatArray, start_prices: FloatArray, costs: FloatArray, owners: NDArray[np.int64]) -> None:
    """Cheapest priced start of every task, into ``costs`` (M,) and ``owners`` (M,)."""
    costs[:] = np.inf
    owners[:] = -1
    for i in range(starts.shape[0]):
        for j in range(starts.shape[1]):
            cost = starts[i, j] + start_prices[i]
            if cost < costs[j]:
                costs[j] = cost
                owners[j] = i


@compiled_for(FLOATS_2, FLOATS_1, FLOATS_1, writable(INTEGERS_1), writable(FLAGS_1), writable(FLOATS_1))
def _grow(
    between: FloatArray,
    roots: FloatArray,
    prices: FloatArray,
    degrees: NDArray[np.int64],
    rooted: NDArray[np.bool_],
    shares: FloatArray,
) -> float:
    """Prim's algorithm from the super-root: the tree's weight, and its make-up by reference.

    Args:
        between: (M, M) m between tasks.
        roots: (M,) m from the cheapest priced start.
        prices: (M,) m, added to a cost once for each task it touches.
        degrees: (M,) filled with each task's neighbours in the tree.
        rooted: (M,) filled with whether the super-root is one of them.
        shares: (M,) filled with the cost of the leg that reached each task.
    """
    num = roots.shape[0]
    keys = np.empty(num)
    parents = np.full(num, -1)
    open_tasks = np.arange(num)
    for j in range(num):
        keys[j] = roots[j] + prices[j]
        degrees[j] = 0
        rooted[j] = False
    total = 0.0
    for left in range(num, 0, -1):
        best = 0
        for k in range(1, left):
            if keys[k] < keys[best]:
                best = k
        task = open_tasks[best]
        total += keys[best]
        shares[task] = keys[best]
        degrees[task] += 1
        if parents[best] < 0:
            rooted[task] = True
        else:
            degrees[parents[best]] += 1
        # The last open task takes the place of the one just reached, so that the loop below runs over open ones only.
        open_tasks[best], keys[best], parents[best] = open_tasks[left - 1], keys[left - 1], parents[left - 1]
        row, price = between[task], prices[task]
        for k in range(left - 1):
            other = open_tasks[k]
            key = row[other] + (price + prices[other])
            if key < keys[k]:
                keys[k] = key
                parents[k] = task
    return total


@compiled_lazily()
def _last_legs(
    ends: FloatArray, idle: FloatArray, needed: int, prices: FloatArray, start_prices: FloatArray, gradient: FloatArray
) -> float:
    """What the fleet flies besides the tree: idle drones, and the priced last legs of drones that gain by them or are needed.

    The rules that this breaks are added to ``gradient`` (M + N,).
    """
    num_drones, num = ends.shape
    total = 0.0
    values, lasts = np.empty(num_drones), np.empty(num_drones, np.int64)
    for i in range(num_drones):
        best, last, farthest = np.inf, -1, 0.0
        for j in range(num):
            if ends[i, j] < np.inf:
                farthest = max(farthest, ends[i, j])
            if ends[i, j] + prices[j] < best:
                best, last = ends[i, j] + prices[j], j
        # A drone without an end may end anywhere for nothing: where, tells the ascent nothing.
        last = last if farthest > 0.0 else -1
        values[i], lasts[i] = best - start_prices[i] - idle[i], last
        total += idle[i]
    for rank, i in enumerate(np.argsort(values)):
        if rank < needed or values[i] < 0.0:
            total += values[i]
            gradient[num + i] -= 1.0
            if lasts[i] >= 0:
                gradient[lasts[i]] += 1.0
    return total if needed <= num_drones else np.inf


@compiled_for(
    FLOATS_2, FLOATS_2, FLOATS_2, FLOATS_1, types.int64, FLOATS_1, writable(FLOATS_1), writable(FLOATS_1)
)  # fmt: skip
def relax(
    starts: FloatArray, between: FloatArray, ends: FloatArray, idle: FloatArray, needed: int, prices: FloatArray,
    gradient: FloatArray, shares: FloatArray,
) -> float:  # fmt: skip
    """The bound that prices prove, metres, and by reference by how much each rule is broken, and the tasks' shares.

    Args:
        starts: (N, M) m from each start to each task; infinite where the drone cannot serve the task.
        between: (M, M) m between tasks; infinite where no drone can serve both.
        ends: (N, M) m from each task to each end; infinite where the drone cannot serve the task.
        idle: (N,) m flown without tasks.
        needed: Drones that fly with tasks at least.
        prices: (M + N,) m, of a task's legs, then of a drone's first leg, earned again by its last one.
        gradient: (M + N,) filled with a task's legs over two, then with a drone's first legs over its last ones.
        shares: (M,) filled with what each task pays of the tree. No group of tasks pays more than a tree of its own would
            cost (Bird 1976), so no route earns more from these shares than it costs, and they are prices of routes that prove
            the bound for any number of drones.
    """
    num = starts.shape[1]
    roots, owners = np.empty(num), np.empty(num, np.int64)
    degrees, rooted = np.empty(num, np.int64), np.empty(num, np.bool_)
    _roots(starts, prices[num:], roots, owners)
    weight = _grow(between, roots, prices[:num], degrees, rooted, shares)
    gradient[num:] = 0.0
    for j in range(num):
        gradient[j] = degrees[j] - 2.0
        shares[j] -= 2.0 * prices[j]
        if rooted[j] and owners[j] >= 0:
            gradient[num + owners[j]] += 1.0
    return weight - 2.0 * prices[:num].sum() + _last_legs(ends, idle, needed, prices[:num], prices[num:], gradient)


@compiled_lazily()
def _some_have_no_end(ends: FloatArray) -> bool:
    lacking = 0
    for i in range(ends.shape[0]):
        lacking += not ((ends[i] > 0.0) & (ends[i] < np.inf)).any()
    return lacking > 0


@compiled_for(
    FLOATS_2, FLOATS_2, FLOATS_2, FLOATS_1, types.int64, types.int64, types.float64,
    *[writable(FLOATS_1)] * 4,
)  # fmt: skip
def ascend(
    starts: FloatArray, between: FloatArray, ends: FloatArray, idle: FloatArray, needed: int, rounds: int, upper: float,
    ascent: FloatArray, prices: FloatArray, direction: FloatArray, best_prices: FloatArray,
) -> bool:  # fmt: skip
    """Some rounds towards the Held-Karp maximum, by a subgradient with Polyak steps to a moving target.

    Args:
        starts: As for `relax`, and so are the next ones.
        between: See there.
        ends: See there.
        idle: See there.
        needed: See there.
        rounds: Spanning trees to grow.
        upper: Travel of a known allocation, or infinity; no target lies above it.
        ascent: (3,) how far the rounds before came (`flockopt.bundles.bounds.polyak.begin`); brought up to date.
        prices: (M + N,) where they came to; moved on.
        direction: (M + N,) of their last step, 0 at first; turned.
        best_prices: (M + N,) the best found; bettered.

    Returns:
        Whether there is farther to go.
    """
    gradient, shares = np.empty(prices.shape[0]), np.empty(starts.shape[1])
    # A task where a drone without an end may rest has two legs at most, and no price below 0.
    held = starts.shape[1] if _some_have_no_end(ends) else 0
    for _ in range(rounds):
        value = relax(starts, between, ends, idle, needed, prices, gradient, shares)
        if not np.isfinite(value):
            return False
        share = DIRECTION_SHARE if ascent[BEST] > -np.inf else 1.0
        if value > ascent[BEST]:
            best_prices[:] = prices
        goal = aim(ascent, value, COOLING, LEAST_REACH, upper)
        norm, steepest = 0.0, 0.0
        for k in range(prices.shape[0]):
            direction[k] = share * gradient[k] + (1.0 - share) * direction[k]
            if k < held and prices[k] <= 0.0:
                direction[k], gradient[k] = max(direction[k], 0.0), max(gradient[k], 0.0)
            norm += direction[k] ** 2
            steepest += gradient[k] ** 2
        if steepest == 0.0:
            return False
        length = (goal - value) / max(norm, steepest)
        for k in range(prices.shape[0]):
            prices[k] += length * direction[k]
            if k < held:
                prices[k] = max(prices[k], 0.0)
    return True
