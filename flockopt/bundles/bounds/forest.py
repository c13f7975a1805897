"""Compiled forest bounds: a spanning tree of the tasks grown from one super-root, and its Held-Karp ascent.

Drop from an allocation everything but its connectedness: every task hangs by some chain of tasks from some
start. Such a forest is a spanning tree of the tasks and one super-root that stands for all starts, so the
cheapest spanning tree bounds the travel. A route also gives every task at most two neighbours and every start
at most one: prices on breaking these rules (Held and Karp 1970) lift the bound.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLAGS_1, FLOATS_1, FLOATS_2, INTEGERS_1, compiled_for, writable
from flockopt.bundles.bounds.polyak import LEAST_REACH, begin, seen, target
from flockopt.records.arrays import FloatArray

__all__ = ["ascend", "forest_value", "task_shares"]

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


@compiled_for(FLOATS_2, FLOATS_2, FLOATS_1, FLOATS_1)
def forest_value(starts: FloatArray, between: FloatArray, prices: FloatArray, start_prices: FloatArray) -> float:
    """The bound that task prices (M,) and start prices (N,), all >= 0, prove; metres."""
    num = starts.shape[1]
    roots, owners = np.empty(num), np.empty(num, np.int64)
    _roots(starts, start_prices, roots, owners)
    weight = _grow(between, roots, prices, np.empty(num, np.int64), np.empty(num, np.bool_), roots.copy())
    return float(weight - 2.0 * prices.sum() - start_prices.sum())


@compiled_for(FLOATS_2, FLOATS_2, FLOATS_1, FLOATS_1)
def task_shares(starts: FloatArray, between: FloatArray, prices: FloatArray, start_prices: FloatArray) -> FloatArray:
    """The bound shared out over the tasks (M,), metres: what each pays to hang on to the tree.

    No group of tasks pays more than a tree of its own would cost (Bird 1976), so no route earns more from these
    shares than it costs, and they are prices of routes that prove the forest's bound.
    """
    num = starts.shape[1]
    roots, owners, shares = np.empty(num), np.empty(num, np.int64), np.empty(num)
    _roots(starts, start_prices, roots, owners)
    _grow(between, roots, prices, np.empty(num, np.int64), np.empty(num, np.bool_), shares)
    return shares - 2.0 * prices


@njit(cache=True)
def _gradient(degrees: NDArray[np.int64], rooted: NDArray[np.bool_], owners: NDArray[np.int64], gradient: FloatArray) -> None:
    """By how much the tree breaks each rule, into ``gradient`` (M + N,): neighbours over two, routes over one."""
    num = degrees.shape[0]
    gradient[num:] = -1.0
    for j in range(num):
        gradient[j] = degrees[j] - 2.0
        if rooted[j]:
            gradient[num + owners[j]] += 1.0


@njit(cache=True)
def _turn(direction: FloatArray, gradient: FloatArray, prices: FloatArray, share: float) -> float:
    """Mix the gradient into the direction, both without what would leave the positive prices; the larger squared norm.

    It is 0 where no price can rise: at the maximum.
    """
    steepest, norm = 0.0, 0.0
    for k in range(direction.shape[0]):
        if prices[k] > 0.0 or gradient[k] > 0.0:
            steepest += gradient[k] ** 2
        direction[k] = share * gradient[k] + (1.0 - share) * direction[k]
        if prices[k] <= 0.0 and direction[k] < 0.0:
            direction[k] = 0.0
        norm += direction[k] ** 2
    return max(steepest, norm) if steepest > 0.0 else 0.0


@compiled_for(FLOATS_2, FLOATS_2, types.int64, types.float64)
def ascend(starts: FloatArray, between: FloatArray, rounds: int, upper: float) -> FloatArray:
    """Prices near the Held-Karp maximum by a projected subgradient with Polyak steps to a moving target.

    Args:
        starts: (N, M) m from each start to each task; infinite where the drone cannot serve the task.
        between: (M, M) m between tasks.
        rounds: Spanning trees to grow.
        upper: Travel of a known allocation, or infinity; no target lies above it.

    Returns:
        (M + N,) the best task prices, then start prices, found.
    """
    num_drones, num = starts.shape
    prices = np.zeros(num + num_drones)
    best_prices = prices.copy()
    gradient, direction = np.zeros(num + num_drones), np.zeros(num + num_drones)
    roots, owners = np.empty(num), np.empty(num, np.int64)
    degrees, rooted, shares = np.empty(num, np.int64), np.empty(num, np.bool_), np.empty(num)
    ascent = begin()
    for step in range(rounds):
        _roots(starts, prices[num:], roots, owners)
        weight = _grow(between, roots, prices[:num], degrees, rooted, shares)
        value = weight - 2.0 * prices[:num].sum() - prices[num:].sum()
        if not np.isfinite(value):
            break
        if value > ascent.best:
            for k in range(num + num_drones):
                best_prices[k] = prices[k]
        ascent = seen(ascent, value, COOLING, LEAST_REACH)
        _gradient(degrees, rooted, owners, gradient)
        norm = _turn(direction, gradient, prices, DIRECTION_SHARE if step else 1.0)
        if norm == 0.0:
            break
        length = (target(ascent, upper) - value) / norm
        for k in range(num + num_drones):
            prices[k] = max(0.0, prices[k] + length * direction[k])
    return best_prices
