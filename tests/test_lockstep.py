"""Items at work side by side, whose questions are answered together."""

from __future__ import annotations

import pytest

from yid_ocp.parallel import batched_call, map_with_batched_calls


class Answers:
    """Squares, and who asked for them together."""

    def __init__(self) -> None:
        self.asked: list[list[int]] = []

    def __call__(self, questions: list[int]) -> list[int]:
        self.asked.append(list(questions))
        return [x * x for x in questions]


def test_questions_of_all_items_meet() -> None:
    squares = Answers()

    def item(i: int) -> int:
        """Asks i + 1 times, one question more every time."""
        total = 0
        for turn in range(i + 1):
            total += sum(batched_call(squares, [10 * i + k for k in range(turn + 1)]))
        return total

    found = map_with_batched_calls(item, range(3))
    assert squares.asked == [[0, 10, 20], [10, 11, 20, 21], [20, 21, 22]]
    assert found == [0, 100 + 100 + 121, 400 + 400 + 441 + 400 + 441 + 484]


def test_more_items_than_are_at_work_at_once_and_two_functions() -> None:
    squares, others = Answers(), Answers()
    found = map_with_batched_calls(lambda i: batched_call(others if i % 2 else squares, [i])[0], range(20))
    assert found == [i * i for i in range(20)]
    assert squares.asked[0] == [0, 2, 4, 6]
    assert others.asked[0] == [1, 3, 5, 7]
    assert sorted(x for group in squares.asked + others.asked for x in group) == list(range(20))


def test_outside_and_within_an_item_one_asks_as_usual() -> None:
    squares = Answers()
    assert batched_call(squares, [3]) == [9]
    found = map_with_batched_calls(
        lambda i: map_with_batched_calls(lambda j: batched_call(squares, [j])[0], range(2)), range(2)
    )
    assert found == [[0, 1], [0, 1]]
    assert squares.asked == [[3], [0, 0], [1, 1]]
    assert map_with_batched_calls(str, []) == []


def test_what_goes_wrong_is_said_where_the_map_was_called() -> None:
    squares = Answers()

    def item(i: int) -> int:
        if i == 1:
            raise ValueError("item 1")
        return batched_call(squares, [i])[0]

    with pytest.raises(ValueError, match="item 1"):
        map_with_batched_calls(item, range(3))

    def refuses(questions: list[int]) -> list[int]:
        raise KeyError(len(questions))

    with pytest.raises(KeyError, match="3"):
        map_with_batched_calls(lambda i: batched_call(refuses, [i]), range(3))


def test_an_interruption_leaves_nobody_waiting() -> None:
    ended = []

    def interrupted(questions: list[int]) -> list[int]:
        raise KeyboardInterrupt

    def item(i: int) -> None:
        try:
            batched_call(interrupted, [i])
        finally:
            ended.append(i)

    with pytest.raises(KeyboardInterrupt):
        map_with_batched_calls(item, range(3))
    assert sorted(ended) == [0, 1, 2]
