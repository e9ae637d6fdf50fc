"""Decisions of the user stay valid in later counts, and narrows the interval."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fruitlangs.engine.counting.accounts.plausible import check_position, check_size
from fruitlangs.engine.counting.accounts.review import Decision, Spot, ball, correct_interval, merge, replay, split
from fruitlangs.engine.errors import CountingError

TIME = "2026-05-01T10:00:00+00:00"


def row(count: int, *, first: int = 1, shift: float = 0.0) -> list[Spot]:
    """Fruit of diameter .1 a unit apart along x."""
    return [ball(first + index, "apple", np.array([index + shift, 0.0, 0.0]), 0.1) for index in range(count)]


def decision(action: str, before=(), after=()) -> Decision:
    return Decision(action, TIME, "", tuple(before), tuple(after))


def test_a_decision_holds_for_the_fruit_that_is_there_whatever_its_number_is_now():
    before = row(3)
    again = [dataclasses.replace(spot, id=9 - spot.id) for spot in row(3, shift=0.03)]
    found = replay([decision("reject", [before[1]]), decision("confirm", [before[2]])], again)
    assert found.standings == ["", "rejected", "confirmed"]
    assert [spot.id for spot in found.spots] == [8, 7, 6]
    assert found.lost == []


def test_a_decision_about_a_fruit_no_longer_found_is_reported_and_changes_nothing():
    gone = decision("reject", [ball(9, "apple", np.array([50.0, 0, 0]), 0.1)])
    found = replay([gone], row(2))
    assert (found.standings, found.lost) == (["", ""], [gone])


def test_a_fruit_half_a_diameter_away_is_another_one():
    near, far = row(1, shift=0.049), row(1, shift=0.051)
    assert replay([decision("reject", row(1))], near).standings == ["rejected"]
    assert replay([decision("reject", row(1))], far).standings == [""]


def test_the_last_word_counts():
    spot = row(1)
    both = [decision("reject", spot), decision("reopen", spot)]
    assert replay(both[:1], spot).standings == ["rejected"]
    assert replay(both, spot).standings == [""]


def test_a_merge_is_made_again_where_the_machine_still_sees_several():
    two = [ball(1, "apple", np.zeros(3), 0.1), ball(2, "apple", np.array([0.07, 0, 0]), 0.1)]
    whole = merge(two, 3)
    found = replay([decision("merge", two, [whole])], [*two, *row(1, first=7, shift=5.0)])
    assert [spot.id for spot in found.spots] == [7, 3]
    assert (found.standings, found.sources) == (["", "added"], [2, -1])


def test_a_merge_that_the_machine_has_made_by_itself_confirms_its_fruit():
    two = [ball(1, "apple", np.zeros(3), 0.1), ball(2, "apple", np.array([0.07, 0, 0]), 0.1)]
    now = [ball(8, "apple", np.array([0.035, 0, 0]), 0.12)]
    found = replay([decision("merge", two, [merge(two, 3)])], now)
    assert [spot.id for spot in found.spots] == [8]
    assert found.standings == ["confirmed"]


def test_a_split_that_the_machine_has_made_by_itself_confirms_its_parts():
    whole = ball(1, "apple", np.zeros(3), 0.2)
    parts, _ = split(whole, 2, np.zeros((0, 3)), [2, 3])
    now = [ball(5 + index, "apple", part.center + 0.01, 0.15) for index, part in enumerate(parts)]
    found = replay([decision("split", [whole], parts)], now)
    assert [spot.id for spot in found.spots] == [5, 6]
    assert found.standings == ["confirmed", "confirmed"]
    again = replay([decision("split", [whole], parts)], [whole])
    assert [spot.id for spot in again.spots] == [2, 3]
    assert again.standings == ["added", "added"]


def test_an_addition_is_made_again_unless_the_machine_found_it():
    new = ball(9, "apple", np.array([0.5, 0, 0]), 0.1)
    assert replay([decision("add", after=[new])], row(2)).standings == ["", "", "added"]
    found = replay([decision("add", after=[new])], [*row(2), ball(4, "apple", np.array([0.51, 0, 0]), 0.1)])
    assert found.standings == ["", "", "confirmed"]


def test_two_fruit_never_have_one_number():
    new = ball(2, "apple", np.array([0.5, 0, 0]), 0.1)
    found = replay([decision("add", after=[new])], row(2))
    assert [spot.id for spot in found.spots] == [1, 2, 3]


def test_a_relabelled_fruit_keeps_its_label_through_a_count():
    spot = row(1)
    other = [dataclasses.replace(spot[0], label="pear")]
    found = replay([decision("relabel", spot, other)], row(1, first=5))
    assert (found.spots[0].label, found.spots[0].id, found.standings) == ("pear", 5, ["confirmed"])


def test_decisions_that_follow_from_each_other_hold_together():
    """Split, one part rejected, the other relabelled; then the machine counts again."""
    whole = ball(1, "apple", np.zeros(3), 0.2)
    parts, _ = split(whole, 2, np.zeros((0, 3)), [2, 3])
    log = [
        decision("split", [whole], parts),
        decision("reject", [parts[0]]),
        decision("relabel", [parts[1]], [dataclasses.replace(parts[1], label="pear")]),
    ]
    found = replay(log, [dataclasses.replace(whole, id=4)])
    assert [spot.label for spot in found.spots] == ["apple", "pear"]
    assert found.standings == ["rejected", "added"]
    assert found.lost == []


@given(st.permutations(range(5)))
def test_the_order_in_which_the_machine_lists_its_fruit_changes_nothing(order):
    fruits = [*row(4), ball(5, "apple", np.array([3.07, 0, 0]), 0.1)]
    log = [decision("reject", [fruits[1]]), decision("merge", fruits[3:5], [merge(fruits[3:5], 9)])]
    straight, shuffled = replay(log, fruits), replay(log, [fruits[index] for index in order])
    told = [
        sorted((spot.id, standing) for spot, standing in zip(each.spots, each.standings, strict=True))
        for each in (straight, shuffled)
    ]
    assert told[0] == told[1]


probabilities = st.lists(st.floats(0.5, 1.0), min_size=1, max_size=30)


@settings(max_examples=200)
@given(probabilities, st.data())
def test_an_interval_holds_the_count_and_never_widens(given_probabilities, data):
    count, p = len(given_probabilities), np.array(given_probabilities)
    machine = (data.draw(st.integers(0, count)), data.draw(st.integers(count, count + 20)))
    reviewed = np.array(data.draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    rejected = data.draw(st.integers(0, int(reviewed.sum())))
    after = count - rejected + data.draw(st.integers(-min(2, count - rejected), 5))
    low, high = correct_interval(count, machine, p, reviewed, rejected, after)
    assert 0 <= low <= after <= high
    assert high - low <= machine[1] - machine[0] + 1
    if not reviewed.any() and rejected == 0 and after == count:
        assert (low, high) == machine
    if reviewed.all():
        assert low == after


def test_reviewing_uncertain_fruit_narrows_more_than_certain_ones():
    p = np.array([0.99] * 50 + [0.55] * 10)
    sure, uncertain = np.arange(60) < 10, np.arange(60) >= 50
    by_sure = correct_interval(60, (50, 70), p, sure, 0, 60)
    by_doubtful = correct_interval(60, (50, 70), p, uncertain, 0, 60)
    assert by_doubtful[0] > by_sure[0] >= 50


def test_fruit_that_the_user_adds_are_no_longer_among_the_missed():
    assert correct_interval(10, (9, 14), np.full(10, 0.9), np.zeros(10, bool), 0, 12)[1] == 14
    assert correct_interval(10, (9, 14), np.full(10, 0.9), np.zeros(10, bool), 0, 17)[1] == 17


def test_an_empty_count_has_an_interval_too():
    assert correct_interval(0, (0, 2), np.zeros(0), np.zeros(0, bool), 0, 1) == (1, 2)


def test_one_fruit_merged_with_itself_is_itself():
    spot = Spot(1, "pear", np.array([1.0, 2, 3]), np.diag([0.06, 0.05, 0.04]))
    twice = merge([spot, spot], 1)
    np.testing.assert_allclose(twice.center, spot.center)
    np.testing.assert_allclose(np.linalg.norm(twice.axes, axis=1), [0.06, 0.05, 0.04])
    assert np.linalg.det(twice.axes) > 0.0


def test_two_halves_next_to_each_other_merge_to_something_long_between_them():
    two = [ball(1, "apple", np.array([x, 0.0, 0.0]), 0.1) for x in (-0.05, 0.05)]
    whole = merge(two, 3)
    np.testing.assert_allclose(whole.center, 0.0, atol=1e-12)
    assert abs(whole.axes[0] @ [1, 0, 0]) == pytest.approx(np.linalg.norm(whole.axes[0]))
    assert np.linalg.norm(whole.axes[0]) > 0.1
    assert np.linalg.norm(whole.axes[2]) == pytest.approx(0.05)


def test_a_split_follows_the_points_and_keeps_the_volume():
    rng = np.random.default_rng(0)
    places = np.array([[0.0, 0, 0], [0.0, 0.1, 0]])
    points = np.concatenate([place + 0.01 * rng.normal(size=(40 + 20 * k, 3)) for k, place in enumerate(places)])
    parts, owners = split(ball(1, "apple", np.array([0.0, 0.05, 0]), 0.12), 2, points, [5, 6])
    assert [part.id for part in parts] == [5, 6]
    np.testing.assert_allclose(parts[0].center, places[1], atol=0.02)  # the larger part is first
    assert (owners == np.repeat([1, 0], [40, 60])).all()
    assert sum(part.diameter**3 for part in parts) == pytest.approx(0.12**3)


def test_a_split_without_points_lies_along_the_longest_axis():
    spot = Spot(1, "pear", np.zeros(3), np.diag([0.09, 0.03, 0.03]))
    parts, _ = split(spot, 3, np.zeros((0, 3)), [1, 2, 3])
    np.testing.assert_allclose([part.center for part in parts], [[-0.06, 0, 0], [0, 0, 0], [0.06, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("parts", [0, 1, 13])
def test_a_split_into_no_parts_or_too_many_is_an_error(parts):
    with pytest.raises(CountingError, match="2 to 12 parts"):
        split(row(1)[0], parts, np.zeros((0, 3)), range(parts))


def test_a_merge_of_fruit_far_apart_is_refused_with_distance_and_limit():
    near = [ball(4, "apple", np.array([x, 0.0, 0.0]), 0.1) for x in (0.0, 0.2)]
    assert merge(near, 3).diameter > 0.1
    far = [*near, ball(9, "apple", np.array([0.21, 0.0, 0.0]), 0.1)]
    with pytest.raises(CountingError, match=r"Fruit 4 and 9 are 2\.1 fruit lengths apart.*up to 2 lengths"):
        merge(far, 3)


def test_halves_of_a_usual_fruit_and_of_a_long_one_are_merged():
    crumbs = [ball(1, "apple", np.array([x, 0.0, 0.0]), 0.02) for x in (0.0, 0.08)]
    with pytest.raises(CountingError):
        merge(crumbs, 3)
    assert merge(crumbs, 3, usual=0.08).diameter > 0.02
    long = [Spot(1, "eggplant", np.array([x, 0.0, 0.0]), np.diag([0.15, 0.03, 0.03])) for x in (0.0, 0.55)]
    assert merge(long, 3).diameter > 0.06


def test_an_old_merge_of_fruit_far_apart_is_not_made_again_and_says_why():
    two = [row(5)[0], row(5)[4]]
    log = [decision("merge", two, [ball(9, "apple", np.array([2.0, 0, 0]), 2.0)]), decision("reject", row(5)[1:2])]
    found = replay(log, row(5))
    assert [spot.id for spot in found.spots] == [1, 2, 3, 4, 5]
    assert found.standings == ["", "rejected", "", "", ""]
    assert found.lost == []
    assert len(found.refused) == 1
    assert "40.0 fruit lengths apart" in found.refused[0]


def test_parts_too_small_for_fruit_are_refused():
    whole = ball(1, "apple", np.zeros(3), 0.1)
    assert len(split(whole, 12, np.zeros((0, 3)), range(12), usual=0.1)[0]) == 12
    with pytest.raises(CountingError, match=r"diameter of 12 parts is 0\.1\d* times the usual one"):
        split(whole, 12, np.zeros((0, 3)), range(12), usual=0.3)


@pytest.mark.parametrize(("ratio", "refused"), [(0.19, True), (0.21, False), (1.0, False), (4.9, False), (5.1, True)])
def test_a_size_is_from_a_fifth_to_five_times_the_usual_one(ratio, refused):
    if refused:
        with pytest.raises(CountingError, match=r"diameter of apple\.003 is .* from 0\.2 to 5 times is possible"):
            check_size("apple.003", ratio * 0.08, 0.08)
        return
    check_size("apple.003", ratio * 0.08, 0.08)
    check_size("apple.003", 100.0 * ratio, 0.0)


def test_a_position_is_within_three_times_the_reach_of_the_cameras():
    cameras = np.array([[4.0, 0, 0], [-4, 0, 0], [0, 4, 0], [0, -4, 0]])
    check_position("apple.003", np.array([0.0, 0, 11.9]), cameras)
    check_position("apple.003", np.array([0.0, 0, 99.0]), cameras[:1])
    for away in (12.1, np.nan):
        with pytest.raises(CountingError, match="times as far from the middle of the photos"):
            check_position("apple.003", np.array([0.0, 0, away]), cameras)
