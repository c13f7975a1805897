"""The order in which one drone visits its tasks: cheapest insertion, then relocation and reversal until neither helps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from flockopt.travel import Travel

__all__ = ["shortest_order"]

#: An order must be shorter by this much to count as better, metres.
LEAST_GAIN_M = 1e-9


def shortest_order(travel: Travel, drone: int, tasks: Iterable[int]) -> tuple[int, ...]:
    """A short order of a drone's tasks: no single relocation or reversal shortens it.

    Args:
        travel: Distances, metres.
        drone: Who flies.
        tasks: What it serves, in any order.
    """
    order: tuple[int, ...] = ()
    for task in tasks:
        places = [(*order[:k], int(task), *order[k:]) for k in range(len(order) + 1)]
        order = min(places, key=lambda route: travel.route_length(drone, route))
    length = travel.route_length(drone, order)
    while True:
        better = min(_neighbours(order), key=lambda route: travel.route_length(drone, route), default=order)
        if travel.route_length(drone, better) >= length - LEAST_GAIN_M:
            return order
        order, length = better, travel.route_length(drone, better)


def _neighbours(order: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """All orders one relocation or one reversal away."""
    for i in range(len(order)):
        rest = order[:i] + order[i + 1 :]
        for k in range(len(order)):
            if k != i:
                yield (*rest[:k], order[i], *rest[k:])
        for j in range(i + 2, len(order) + 1):
            yield order[:i] + order[i:j][::-1] + order[j:]
