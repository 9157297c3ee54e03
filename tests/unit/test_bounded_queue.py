"""The bounded queue: behaviour without room, and its end."""

from __future__ import annotations

import threading

from rig.serve.waiting import BoundedQueue, take_first
from tests.waiting import PATIENCE_S


def test_a_full_queue_refuses_drops_the_oldest_or_waits() -> None:
    queue = BoundedQueue[str](2)
    assert [queue.offer(each) for each in "abc"] == [True, True, False]
    assert (queue.used, queue.high_water, queue.dropped) == (2, 2, 1)
    assert queue.offer("d", room=3), "documents have room of their own"
    assert queue.push("e") == 2
    assert not queue.put("f", timeout_s=0.0)
    assert not queue.wait_for_room(0.0)
    assert (queue.dropped, queue.high_water) == (3, 3)
    assert queue.take_many(9) == ["d", "e"]
    assert queue.wait_for_room(0.0)
    assert queue.take(0.0) is None


def test_a_wait_for_room_or_an_item_ends() -> None:
    queue = BoundedQueue[int](1)
    items: list[int | None] = []
    reader = threading.Thread(target=lambda: items.extend(queue.take(10.0) for _ in range(3)))
    reader.start()
    assert queue.put(1, 10.0)
    assert queue.put(2, 10.0)
    assert queue.wait_for_room(10.0)
    queue.close()
    reader.join(PATIENCE_S)
    assert items == [1, 2, None]


def test_a_taken_item_counts_until_the_next_is_taken() -> None:
    inbox = BoundedQueue[bytes](100, size=len, holds=True)
    for _ in range(3):
        inbox.offer(bytes(40))
    assert inbox.dropped == 1
    assert len(inbox.take_many(1000, 0.0)) == 2
    inbox.offer(bytes(40))
    assert inbox.dropped == 2
    assert inbox.take_many(1000, 0.0) == []
    inbox.offer(bytes(40))
    assert (inbox.dropped, inbox.used, inbox.high_water) == (2, 40, 80)


def test_the_next_item_inherits_from_a_dropped_one() -> None:
    queue = BoundedQueue[list[str]](
        1, size=lambda item: "block" in item, inherit=lambda dropped, following: following.extend(dropped)
    )
    assert queue.push(["start"]) == 0
    assert queue.push(["block", "a"]) == 0
    assert queue.push(["block", "b"]) == 1
    assert queue.dropped == 1
    queue.close()
    assert queue.push(["late"]) == 0
    assert queue.take_many(9) == [["block", "b", "block", "a", "start"], ["late"]]
    assert queue.ended


def test_items_without_size_are_not_dropped_without_an_heir() -> None:
    queue = BoundedQueue[str](2, size=lambda item: item.isdigit())
    for item in ("start", "1", "fault", "2", "3", "stop", "4"):
        queue.push(item)
    assert queue.dropped == 2
    assert queue.take_many(9) == ["start", "fault", "3", "stop", "4"]


def test_a_closed_queue_returns_its_items_and_accepts_no_more() -> None:
    queue = BoundedQueue[int](5)
    queue.offer(1)
    queue.close()
    assert (queue.closed, queue.ended) == (True, False)
    assert not queue.offer(2)
    assert not queue.put(3)
    assert queue.dropped == 0, "the end is no want of room"
    assert queue.wait_for_item(10.0)
    assert queue.take() == 1
    assert queue.ended
    assert not queue.wait_for_item(10.0)


def test_the_first_of_two_queues_has_priority() -> None:
    changed = threading.Condition()
    replies, data = BoundedQueue[str](5, changed=changed), BoundedQueue[str](5, changed=changed)
    data.offer("data")
    replies.offer("reply")
    assert [take_first(changed, (replies, data), 0.0) for _ in range(3)] == ["reply", "data", None]
    data.offer("forgotten")
    data.clear()
    assert data.used == 0
    replies.close()
    assert take_first(changed, (replies, data)) is None
