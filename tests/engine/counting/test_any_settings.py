"""Any settings together, on scenes of a few fruit or none: a count, or one line that says what to change."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import simulated_fruit as sim
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.errors import ConfigError, FruitLangsError
from fruitlangs.engine.report.tables import fruits_csv, summary
from fruitlangs.engine.setting import range_of

FILES = {"template"}
"""Settings that name a file."""
PLACE = st.floats(-3.0, 3.0, width=16)
LISTS = {
    "box": st.tuples(*[PLACE] * 6),
    "polygon": st.lists(st.tuples(PLACE, PLACE, PLACE), min_size=1, max_size=4).map(lambda rows: sum(rows, ())),
    "heights": st.tuples(PLACE, PLACE),
    "tree_places": st.lists(st.tuples(PLACE, PLACE, PLACE), min_size=1, max_size=4).map(lambda rows: sum(rows, ())),
}


def bounds_of(setting: dataclasses.Field[Any], kind: Any) -> st.SearchStrategy[Any]:
    """The default of a setting most of the time, else a value at or near one of its bounds."""
    usual = st.just(setting.default)
    if setting.name in LISTS:
        return st.one_of(*[usual] * 5, LISTS[setting.name])
    if get_origin(kind) is Literal:
        return st.sampled_from([*[setting.default] * 2, *get_args(kind)])
    allowed = range_of(setting)
    assert allowed is not None, f"{setting.name} needs values here"
    whole = kind is int
    near = [allowed.low, min(allowed.high, 1e6)]
    near += [allowed.low + 1, allowed.low + 2, allowed.low + 3] if whole else [allowed.low + 1e-6, 0.3, 1.0]
    fit = [(int if whole else float)(value) for value in near if value in allowed and math.isfinite(value)]
    return st.one_of(*[usual] * 3, st.sampled_from(fit))


KINDS = get_type_hints(CountConfig)
SETTINGS = st.fixed_dictionaries(
    {each.name: bounds_of(each, KINDS[each.name]) for each in dataclasses.fields(CountConfig) if each.name not in FILES}
)


@cache
def tree_of(fruit: int) -> sim.Simulation:
    tree = sim.simulate(sim.Setting(fruit=max(fruit, 1), clump=2, sheets=0, floaters=4, views=6, patches=60), seed=1)
    return tree if fruit else dataclasses.replace(tree, probability=np.minimum(tree.probability, 0.04))


def is_counted(fruit: int, values: dict[str, Any]) -> bool:
    """Whether settings count the tree with that many fruit; False if they are refused."""
    tree = tree_of(fruit)
    try:
        config = CountConfig(**values)
        found = count_fruit(
            tree.gaussians, tree.probability, tree.cameras, config, label="apple", visibility=tree.visibility
        )
    except FruitLangsError:
        return False
    rows = fruits_csv(found, metres_per_unit=None).splitlines()
    assert len(rows) == 1 + found.count == 1 + len({each.id for each in found.fruits})
    on_trees = sum(each.tree is not None for each in found.fruits)
    assert sum(each.count for each in found.trees) == on_trees
    summary(found, prompt="apple", threshold=config.threshold, metres_per_unit=None, seconds={})
    return True


@settings(max_examples=40, suppress_health_check=list(HealthCheck))
@given(fruit=st.sampled_from([0, 1, 2, 3]), values=SETTINGS)
def test_any_settings_count_or_say_in_one_line_what_to_change(fruit: int, values: dict[str, Any]) -> None:
    is_counted(fruit, values)


@pytest.mark.parametrize("fruit", [0, 1, 2, 3])
@pytest.mark.parametrize("trees", [1, 2, 3])
def test_any_number_of_trees_with_any_number_of_fruit_is_answered(fruit: int, trees: int) -> None:
    found = is_counted(fruit, {"trees": trees})
    assert found or trees > 1


def test_a_setting_outside_its_bounds_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"--count\.sample-budget is 99"):
        CountConfig(sample_budget=99)
