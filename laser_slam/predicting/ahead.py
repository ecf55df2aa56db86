"""Make things in a thread of their own, before they are asked for."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import NoReturn, TypeVar

Item = TypeVar("Item")
SECONDS_BETWEEN_LOOKS = 0.05


def ahead(
    items: Iterable[Item], idle: Callable[[], AbstractContextManager[None]] = nullcontext
) -> Generator[Item, None, None]:
    """Make each item in a thread of its own while the one before is used.

    Closing the generator ends the thread, once the item that it is at is made.

    Args:
        items: are made in order, as without this.
        idle: is entered while one thread waits for the other.
    """
    made: queue.Queue[Callable[[], Item]] = queue.Queue(maxsize=1)
    is_over = threading.Event()
    thread = threading.Thread(target=_make, args=(iter(items), made, is_over, idle), daemon=True)
    thread.start()
    try:
        while True:
            with idle():
                take = made.get()
            try:
                item = take()
            except StopIteration:
                return
            yield item
    finally:
        is_over.set()
        while thread.is_alive():
            with suppress(queue.Empty):
                made.get(timeout=SECONDS_BETWEEN_LOOKS)


def _make(
    items: Iterator[Item],
    made: queue.Queue[Callable[[], Item]],
    is_over: threading.Event,
    idle: Callable[[], AbstractContextManager[None]],
) -> None:
    """Put the making of each item, and what ended it, into a queue."""
    while not is_over.is_set():
        take = _result_of(items)
        with idle():
            made.put(take)
        if isinstance(take, _Raise):
            break
    if isinstance(items, Generator):
        items.close()


def _result_of(items: Iterator[Item]) -> Callable[[], Item]:
    try:
        item = next(items)
    except BaseException as error:  # noqa: BLE001  (is raised where the item is taken)
        return _Raise(error)
    return lambda: item


class _Raise:
    """What ended the making of items, to be raised where the next one is asked for."""

    def __init__(self, error: BaseException) -> None:
        self._error = error

    def __call__(self) -> NoReturn:
        raise self._error
