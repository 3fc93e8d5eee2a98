"""The course of a search whose judge is a formula: where kinds begin, what is compared, and where it ends."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest

from softneck.core import DataError, SettingsError
from softneck.estimation import KalmanSettings
from softneck.robot import Robot
from softneck.tuning import _certify, _search, _tune, tune
from softneck.tuning._search import Search
from softneck.tuning._space import KINDS_SEARCHED, spaces
from softneck.tuning._task import Judgement, Log, Task, digest_of
from softneck.verification._requirements import Requirement

from ..design.test_robots import plant
from ..verification.necks import linear_neck

BOUNDS = (
    Requirement("axes.sensitivity", "max", 2.5, False), Requirement("axes.gain_margin", "min", 2.0, False),
    Requirement("sim.rise_s", "max", 0.4, True), Requirement("sim.overshoot_pct", "max", 5.0, True),
)  # fmt: skip
# Of a kind: what its Ms is certified as, in parts of what is asked of the design.
CERTIFIED = {"pi": 1.6, "hinf": 1.2}


def judged(_: Any, kind: str, settings: Mapping[str, Any], level: str) -> Judgement:
    """A loop that is quicker and overshoots more the more is asked, as far as Ms goes that it is designed for."""
    Ms, rise = settings["max_sensitivity"], 2.0 * settings["reference_time"][0]
    certified = CERTIFIED[kind] * Ms
    if level == "linear":
        return Judgement({"axes.sensitivity": certified, "axes.gain_margin": certified / (certified - 1.0)})
    if level == "margins":
        return Judgement({"axes.gain_margin": 2.2 - 0.1 * certified})
    return Judgement({"sim.rise_s": rise + 0.45 / Ms**2, "sim.overshoot_pct": 1.0 / rise})


def searched(monkeypatch: pytest.MonkeyPatch, budget: int, tested: bool = True, tell: Any = lambda *_: None) -> Search:
    monkeypatch.setattr(_search, "judge_candidate", judged)
    task: Any = SimpleNamespace(
        asked=SimpleNamespace(bounds=BOUNDS), bounds=BOUNDS, aims=BOUNDS, final_aims=BOUNDS, own={"neck": 0}, seed=0,
        tested=tested, drawn=(),
    )  # fmt: skip
    each = spaces(("pi", "hinf"), rise=0.4, cocontraction=None, robot=Robot.preset())
    found = Search(task, each, None, Log(None, ""), budget, tell)
    found.run()
    return found


def test_kinds_begin_at_the_largest_bound_on_Ms_that_their_margins_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    # Of each kind the start, three halvings and the loops there, and the margins of three.
    found = searched(monkeypatch, 13)
    for space in found.spaces:
        (led,) = [
            item for item in found.candidates.values() if item.kind == space.kind and item.level not in ("", "linear")
        ]
        dimension = space.dimensions[space.trade_off or 0]
        # A gain margin of 2 is a certified Ms of 2.
        most = math.log(2.0 / CERTIFIED[space.kind] / dimension.low) / math.log(dimension.high / dimension.low)
        # 0.24 of the range, 0.12 and 0.06: within the last of them, if it is within all of them of the start.
        if abs(most - space.start[space.trade_off or 0]) < 0.42:
            assert most - 0.12 <= led.x[space.trade_off or 0] <= most
        assert found._is_robust(led)


@pytest.mark.parametrize("tested", [True, False])
def test_nothing_that_was_judged_as_far_is_better_than_the_best(monkeypatch: pytest.MonkeyPatch, tested: bool) -> None:
    found = searched(monkeypatch, 90, tested)
    ranked = found.sort_candidates()
    best = ranked[0]
    assert len(found.spent) <= 90
    assert best.level == "margins"
    least = {"axes.gain_margin"}
    for other in (item for item in ranked[1:] if item.level == best.level):
        values = [
            (-1.0 if name in least else 1.0) * (other.metrics[name] - best.metrics[name]) for name in other.metrics
        ]
        assert max(values) >= 0.0, "the best is dominated"
    # 1/rise is at most 5 % from 0.2 s on, and a gain margin of 2 leaves an Ms of 1.67, where 0.45/Ms**2 is 0.16 s.
    assert best.holds(BOUNDS, tested=tested)


def test_a_search_ends_nearer_to_what_is_wanted_than_it_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    costs = []
    for budget in (13, 40, 90, 200):
        found = searched(monkeypatch, budget)
        looped = [item for item in found.candidates.values() if "sim.rise_s" in item.metrics]
        # Without what experiments said of the few that had them.
        costs.append(min(item.cost(BOUNDS[:1] + BOUNDS[2:], tested=True) for item in looped))
    assert costs == sorted(costs, reverse=True), "a larger budget ended farther off"
    assert costs[-1] < costs[0]
    # What is searched at last, near the best, is within a hundredth of where both limits are met alike: 0.98 of them.
    assert costs[-1] < 0.995


def test_what_a_search_says_of_its_course_only_grows_within_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[tuple[float, str]] = []
    found = searched(monkeypatch, 40, tell=lambda *told: said.append(told))
    shares = [share for share, _ in said]
    assert shares == sorted(shares)
    # With each judgement, also within a generation; of the four final candidates those that cannot win are left out.
    assert set(shares) == {done / 40 for done in range(1, len(found.spent) + 1)}
    assert 37 <= len(found.spent) <= 40
    assert said[0][1] == "nothing yet"
    assert said[-1][1].startswith(f"best {found.sort_candidates()[0].kind}, rise")


class Begun(Exception):
    """What `tune` has made before its search."""


def begun(monkeypatch: pytest.MonkeyPatch, plants: Any = None, **asked: Any) -> Search:
    """Return the search that `tune` begins."""

    def run(self: Search) -> None:
        raise Begun(self)

    monkeypatch.setattr(_tune, "prepare", lambda _: None)
    monkeypatch.setattr(Search, "run", run)
    with pytest.raises(Begun) as found:
        tune({"n": linear_neck()} if plants is None else plants, {}, workers=0, **asked)
    return found.value.args[0]


@pytest.mark.parametrize(
    ("kinds", "searched"),
    [("pi", ("pi",)), ("lqg,pi", ("lqg", "pi")), (["pi", "lqg"], ("pi", "lqg")), ("pi,lqg,pi", ("pi", "lqg")),
     ("", None), ((), None)],
)  # fmt: skip
def test_the_kinds_that_are_named_are_searched_once_each_and_else_the_usual_ones(
    kinds: Any, searched: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kinds == "":  # no name at all is a name of nothing
        with pytest.raises(SettingsError, match="unknown kind"):
            tune({"n": linear_neck()}, {}, kinds=kinds)
        return
    found = begun(monkeypatch, kinds=kinds, budget=7, seed=3)
    assert tuple(space.kind for space in found.spaces) == (searched or KINDS_SEARCHED)
    assert (found.budget, found.task.seed, found.dropped, found.log.folder) == (7, 3, {}, None)
    assert (found.finals, found.earlier) == (4, 0)
    assert found.task.digest == digest_of(found.task, searched or KINDS_SEARCHED, None)


def test_what_is_never_certified_beside_recordings_is_searched_only_where_it_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Task, "tested", True)
    found = begun(monkeypatch)
    assert [space.kind for space in found.spaces] == [kind for kind in KINDS_SEARCHED if kind != "adaptive"]
    assert list(found.dropped) == ["adaptive"]
    assert "--kinds" in found.dropped["adaptive"]
    named = begun(monkeypatch, kinds="adaptive")
    assert ([space.kind for space in named.spaces], named.dropped) == (["adaptive"], {})


@pytest.mark.parametrize(
    ("asked", "said"),
    [({"budget": 0}, "budget"), ({"budget": 1_000_001}, "budget"), ({"budget": 2.5}, "budget"), ({"seed": -1}, "seed"),
     ({"seed": 2**31 - 1}, "seed")],
)  # fmt: skip
def test_a_budget_and_a_seed_have_their_ends(asked: dict[str, Any], said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingsError, match=said):
        tune({"n": linear_neck()}, {}, **asked)
    for budget, seed in ((1, 0), (1_000_000, 2**31 - 2)):
        found = begun(monkeypatch, kinds="pi", budget=budget, seed=seed)
        assert (found.budget, found.task.seed) == (budget, seed)


def test_the_observer_that_is_given_is_that_of_the_loops_and_must_be_of_the_robot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert begun(monkeypatch, kinds="pi").task.observer.sample_time == linear_neck().pitch.dt
    own = KalmanSettings().design(linear_neck())
    assert begun(monkeypatch, kinds="pi", observer=own).task.observer is own
    with pytest.raises(DataError, match="the observer and the plants"):
        tune({"n": linear_neck()}, {}, observer=KalmanSettings().design(plant(Robot.preset("antagonist"))))


def test_a_search_aims_at_the_cocontraction_of_the_recordings_in_four_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_tune, "_recorded_cocontraction", lambda *_: 0.123456)
    [space] = begun(monkeypatch, kinds="pi").spaces
    assert space.fixed["least_cocontraction"] == 0.1235
    monkeypatch.setattr(_tune, "_recorded_cocontraction", lambda *_: None)
    assert "least_cocontraction" not in begun(monkeypatch, kinds="pi").spaces[0].fixed


def test_a_tuning_says_how_far_it_is_from_nothing_to_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three quarters are the search, the rest its certificates; its result is of what they end with."""
    said: list[float] = []

    def course(*given: Any) -> None:
        tell = given[-1]
        for share in (0.0, 0.5, 1.0):
            tell(share, "")

    monkeypatch.setattr(_tune, "prepare", lambda _: None)
    monkeypatch.setattr(Search, "run", lambda self: course(self.report))
    monkeypatch.setattr(_tune, "certify_search", lambda *given: course(*given) or ("search", "best", 3))
    monkeypatch.setattr(_tune, "_make_result", lambda *given: course(*given) or given[:4])
    found = tune({"n": linear_neck()}, {}, kinds="pi", workers=0, files={"f": ("a", "b")},
                 progress=lambda share, _: said.append(share))  # fmt: skip
    assert found == ("search", "best", 3, {"f": ("a", "b")})
    assert said == pytest.approx([0.0, 0.375, 0.75, *[0.75, 0.875, 1.0] * 2])


@pytest.mark.parametrize("attempts", [[], [2], [2, 5], [5, 2], [100], [100, 7]])
def test_there_are_as_many_certificates_as_every_family_has_draws_for_and_at_most_five(attempts: list[int]) -> None:
    families = {str(k): SimpleNamespace(draws=SimpleNamespace(attempts=count)) for k, count in enumerate(attempts)}
    task: Any = SimpleNamespace(linear={"model": object(), "other": SimpleNamespace(draws=None), **families})
    assert _certify.most_attempts(task) == min([5, *attempts])
