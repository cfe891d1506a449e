"""Lists of items, as in FreeRTOS's list.c: rings through an end, and the item that ran last."""

from firmware_py.rtos.compiled import compiled
from firmware_py.rtos.memory import ITEMS, LISTS, SUSPENDED, KernelMemory


@compiled
def clear_lists(k: KernelMemory) -> None:
    """Make all lists empty, and put all items in none."""
    for ring in range(LISTS):
        end = ITEMS + ring
        k.next[end] = end
        k.previous[end] = end
        k.latest[ring] = end
    for item in range(ITEMS):
        k.place[item] = SUSPENDED


@compiled
def link(k: KernelMemory, ring: int, item: int, follower: int) -> None:
    """Put an item into a list, before another."""
    before = k.previous[follower]
    k.next[before] = item
    k.previous[item] = before
    k.next[item] = follower
    k.previous[follower] = item
    k.place[item] = ring
    k.size[ring] += 1


@compiled
def append(k: KernelMemory, ring: int, item: int) -> None:
    """Put an item where its turn comes last: before the item that ran last."""
    link(k, ring, item, k.latest[ring])


@compiled
def insert(k: KernelMemory, ring: int, item: int) -> None:
    """Put an item into its order, behind equal ones."""
    follower = k.next[ITEMS + ring]
    while follower < ITEMS and k.order[follower] <= k.order[item]:
        follower = k.next[follower]
    link(k, ring, item, follower)


@compiled
def remove(k: KernelMemory, item: int) -> None:
    """Take an item out of the list that holds it, if one does."""
    ring = k.place[item]
    if ring < 0:
        return
    before, after = k.previous[item], k.next[item]
    k.next[before] = after
    k.previous[after] = before
    if k.latest[ring] == item:
        k.latest[ring] = before
    k.size[ring] -= 1
    k.place[item] = SUSPENDED


@compiled
def first_of(k: KernelMemory, ring: int) -> int:
    """Return the first item of a list that is not empty."""
    return int(k.next[ITEMS + ring])


@compiled
def turn(k: KernelMemory, ring: int) -> int:
    """Return the item whose turn it is, in a list that is not empty."""
    item = k.next[k.latest[ring]]
    if item >= ITEMS:
        item = k.next[item]
    k.latest[ring] = item
    return int(item)
