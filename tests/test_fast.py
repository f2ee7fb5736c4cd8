"""The tests of `make fast`: the cheapest ones, and every new one."""

from pathlib import Path

from tests.fast import function_of, named_slow, slow_functions


def test_the_cheapest_go_first():
    calls = {"a::dear": 5.0, "b::cheap": 1.0, "c::one": 0.5, "c::two": 0.5}
    both = ["c::one", "c::two"]
    assert slow_functions(calls, {"c": 3.0}, both, budget_s=5.0) == ["a::dear"]
    assert slow_functions(calls, {"c": 3.0}, both, budget_s=3.0) == ["a::dear", "c::two"]
    assert slow_functions(calls, {"c": 3.0}, both[1:], budget_s=2.0) == ["a::dear", "c::two"]
    assert slow_functions(calls, {}, (), budget_s=8.0) == []


def test_a_slow_function_is_one_that_is_there():
    root = Path(__file__).parents[1]
    for name in named_slow():
        path, function = function_of(name).rsplit("::", 1)
        assert f"def {function}(" in (root / path.split("::")[0]).read_text(encoding="utf-8"), name
