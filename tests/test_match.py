"""One answer from two maps: accepted where they meet, refused where they do not, in any frame."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commonmap.config import Config
from commonmap.errors import EmptyMapError, InputError
from commonmap.matching.decide import Figures, decide, features, is_open, told_apart
from commonmap.matching.figures import is_told_at_a_glance
from commonmap.matching.match import match
from commonmap.matching.search import Peaks, SearchPlan, search_both
from commonmap.types import Cloud, Float64s, Leaves, Match
from matching_scenes import Place, apart, look, make_place, moved, rigid

UTM = np.array([470_641.0, 3_810_235.0, 2_278.0])


def pair(seed: int) -> tuple[Float64s, Float64s]:
    """Return a drone's and a ground robot's look at one place, in one frame."""
    place = make_place(seed)
    target = look(place, np.random.default_rng(100 + seed))
    source = look(
        place, np.random.default_rng(200 + seed), roofs=False, edge=26.0, centre=(3.0, -2.0)
    )
    return target, source


def best_of(answer: Match) -> Float64s:
    """Return the pose of an answer, or of its first rival where it was refused."""
    if answer.T_target_source is not None:
        return answer.T_target_source
    return answer.rivals[0].T_target_source


@pytest.fixture(scope="module")
def plain() -> tuple[Float64s, Float64s, Match]:
    """Return a pair in one frame, and the answer to it."""
    target, source = pair(0)
    return target, source, match(target, source)


def test_a_place_seen_twice_is_accepted(plain: tuple[Float64s, Float64s, Match]) -> None:
    _, source, answer = plain
    assert answer.accepted
    assert answer.T_target_source is not None and answer.covariance is not None
    metres, degrees = apart(answer.T_target_source, np.eye(4), source)
    assert metres < 0.05
    assert degrees < 0.1
    assert answer.reason.startswith("accepted")
    assert 0.5 < answer.confidence <= 1.0
    assert 0.9 < answer.overlap <= 1.0
    assert answer.score > answer.decoy_score > 0.0
    assert np.linalg.eigvalsh(answer.covariance).min() > 0.0
    assert answer.covariance_centre is not None
    assert np.abs(answer.covariance_centre[:2] - [3.0, -2.0]).max() < 3.0
    assert set(answer.timings) == {"prepare", "grid", "search", "refine", "decide"}
    assert all(rival.score <= answer.score for rival in answer.rivals)


def test_the_picture_peaks_where_the_map_lies(plain: tuple[Float64s, Float64s, Match]) -> None:
    _, _, answer = plain
    picture = answer.picture
    assert picture is not None and answer.T_target_source is not None
    assert picture.score.shape == (len(picture.x), len(picture.y))
    assert np.all(np.diff(picture.x) > 0) and np.all(np.diff(picture.y) > 0)
    i, j = np.unravel_index(int(np.nanargmax(picture.score)), picture.score.shape)
    at = moved(answer.T_target_source, picture.centre[None])[0]
    step = picture.x[1] - picture.x[0]
    assert abs(picture.x[i] - at[0]) < 1.6 * step
    assert abs(picture.y[j] - at[1]) < 1.6 * step
    assert len(picture.yaw) == len(picture.best_per_yaw)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_answer_follows_a_displacement_of_the_source(
    plain: tuple[Float64s, Float64s, Match], seed: int
) -> None:
    target, source, answer = plain
    rng = np.random.default_rng(seed)
    x, y, z = rng.uniform(-300, 300, 3)
    D = rigid(x, y, z, rng.uniform(-math.pi, math.pi))
    again = match(target, moved(D, source))
    assert again.accepted == answer.accepted
    assert again.T_target_source is not None
    metres, degrees = apart(again.T_target_source @ D, best_of(answer), source)
    assert metres < 0.05
    assert degrees < 0.1


def test_a_tilted_source_is_levelled_and_matched(plain: tuple[Float64s, Float64s, Match]) -> None:
    target, source, _ = plain
    c, s = math.cos(math.radians(6.0)), math.sin(math.radians(6.0))
    D = np.eye(4)
    D[1:3, 1:3] = [[c, -s], [s, c]]
    answer = match(target, moved(D, source))
    assert answer.accepted
    assert answer.T_target_source is not None and answer.T_level_source is not None
    metres, degrees = apart(answer.T_target_source @ D, np.eye(4), source)
    assert metres < 0.06
    assert degrees < 0.15
    up = answer.T_level_source[:3, :3] @ D[:3, :3] @ [0.0, 0.0, 1.0]
    assert math.degrees(math.acos(up[2])) < 0.5


@pytest.mark.parametrize(("one", "other"), [(0, 1), (2, 3), (4, 5)])
def test_different_places_are_refused(one: int, other: int) -> None:
    answer = match(pair(one)[0], pair(other)[1])
    assert not answer.accepted
    assert answer.T_target_source is None
    assert answer.covariance is None and answer.covariance_centre is None
    assert answer.reason.startswith("refused: ")
    assert answer.confidence < 0.9
    assert 1 <= len(answer.rivals) <= Config().search.n_rivals
    assert answer.rivals[0].T_target_source.shape == (4, 4)
    assert set(answer.evidence) >= set(figures_of_a_good_match().as_dict())


def test_a_cloud_an_array_and_bad_rows_give_one_answer(
    plain: tuple[Float64s, Float64s, Match],
) -> None:
    target, source, answer = plain
    holes = source.copy()
    holes = np.insert(holes, [0, 50, len(holes)], np.nan, axis=0)
    holes[0] = [1.0, np.inf, 2.0]
    again = match(Cloud(target), Cloud(holes))
    assert again.accepted
    assert best_of(again).tobytes() == best_of(answer).tobytes()
    assert again.evidence == answer.evidence


def as_leaves(xyz: Float64s, resolution: float) -> Leaves:
    """Return the occupied smallest voxels of a cloud, keys as OctoMap counts them."""
    keys = np.unique(np.floor(xyz / resolution).astype(np.int64) + 32768, axis=0)
    n = len(keys)
    return Leaves(
        resolution, keys.astype(np.uint16), np.full(n, 16, np.uint8), np.full(n, 0.85, np.float32)
    )


def test_octrees_are_matched_too(plain: tuple[Float64s, Float64s, Match]) -> None:
    target, source, _ = plain
    answer = match(as_leaves(target, 0.1), as_leaves(source, 0.1))
    assert answer.accepted
    assert answer.T_target_source is not None
    metres, degrees = apart(answer.T_target_source, np.eye(4), source)
    assert metres < 0.08
    assert degrees < 0.2


def test_utm_coordinates(plain: tuple[Float64s, Float64s, Match]) -> None:
    target, source, answer = plain
    there = match(target + UTM, moved(rigid(0.0, 0.0, 0.0, 1.0), source))
    assert there.accepted
    assert there.T_target_source is not None and there.covariance_centre is not None
    truth = np.eye(4)
    truth[:3, 3] = UTM
    metres, _ = apart(there.T_target_source @ rigid(0.0, 0.0, 0.0, 1.0), truth, source)
    assert metres < 0.05
    assert answer.covariance_centre is not None
    assert there.covariance_centre - UTM == pytest.approx(answer.covariance_centre, abs=3.0)


def test_the_same_input_gives_the_same_bytes(plain: tuple[Float64s, Float64s, Match]) -> None:
    target, source, answer = plain
    again = match(target.copy(), source.copy())
    assert best_of(again).tobytes() == best_of(answer).tobytes()
    assert again.evidence == answer.evidence
    assert [r.score for r in again.rivals] == [r.score for r in answer.rivals]


def test_the_input_is_left_as_it_was(plain: tuple[Float64s, Float64s, Match]) -> None:
    target, source = pair(0)
    assert np.array_equal(plain[0], target)
    assert np.array_equal(plain[1], source)


def test_a_metric_on_heights_goes_the_same_way(plain: tuple[Float64s, Float64s, Match]) -> None:
    target, source, _ = plain
    config = Config().with_values(search={"metric": "zncc", "min_overlap": 0.7})
    answer = match(target, source, config=config)
    assert answer.metric == "zncc"
    metres, degrees = apart(best_of(answer), np.eye(4), source)
    assert metres < 0.3
    assert degrees < 1.0


def test_an_unknown_metric_is_named() -> None:
    config = Config().with_values(search={"metric": "nonsense"})
    with pytest.raises(InputError, match=r"no metric named 'nonsense'; there are .*evidence"):
        match(np.zeros((500, 3)), np.zeros((500, 3)), config=config)


def test_decide_off_accepts_whatever_there_is() -> None:
    config = Config().with_values(decide={"mode": "off"})
    answer = match(pair(0)[0], pair(1)[1], config=config)
    assert answer.accepted
    assert answer.T_target_source is not None
    assert "off" in answer.reason
    assert answer.confidence < 0.9  # it does not pretend


def test_too_little_to_match_raises() -> None:
    rng = np.random.default_rng(1)
    good = pair(0)[0]
    with pytest.raises(EmptyMapError, match="source has 99 finite points"):
        match(good, rng.uniform(0, 10, (99, 3)))
    with pytest.raises(EmptyMapError, match="target has 500 finite points over"):
        match(rng.uniform(0, 0.5, (500, 3)), good)
    with pytest.raises(EmptyMapError, match="target holds no finite point"):
        match(np.full((500, 3), np.nan), good)
    with pytest.raises(InputError, match="shape"):
        match(good, np.zeros((500, 2)))
    with pytest.raises(InputError, match="spans 200 km"):
        match(good, np.array([[0.0, 0, 0], [200_000.0, 0, 0]] * 60))


def test_a_bare_floor_has_nothing_to_match() -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(-15, 15, (20_000, 2))
    floor = np.column_stack([xy, rng.normal(0.0, 0.02, len(xy))])
    with pytest.raises(EmptyMapError, match="nothing stands on the ground of the source"):
        match(pair(0)[0], floor)


def test_progress_names_the_steps() -> None:
    told: list[str] = []
    match(*pair(6), progress=lambda step, share=0.0: told.append(step))
    steps = list(dict.fromkeys(told))
    assert steps[0] == "prepare the maps"
    assert {"search", "refine", "decide"} <= set(steps)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_row_of_equal_yards_is_ambiguous_and_says_so(seed: int) -> None:
    rng = np.random.default_rng(seed)
    yard = make_place(seed, 14.0, n_boxes=3, n_posts=4)
    shifts = 14.0 * np.arange(-2, 3)
    boxes, posts = (
        np.vstack([things + np.eye(1, things.shape[1]) * shift for shift in shifts])
        for things in (yard.boxes, yard.posts)
    )
    row = Place(boxes, posts, 0.0, 70.0)
    draft = look(row, rng, roofs=False, edge=26.0, centre=(0.0, 0.0))
    answer = match(look(row, rng), draft)
    assert not answer.accepted
    assert answer.confidence < 0.8
    assert "another pose is nearly as good" in answer.reason
    assert len(answer.rivals) > 1


# The verdict: behaviour whatever the weights -----------------------------------------------------


def figures_of_a_good_match() -> Figures:
    """Return figures that any model should accept."""
    good = {
        "decoy_ratio": 8.0,
        "second_ratio": 8.0,
        "prominence": 30.0,
        "support": 1.0,
        "effect": 0.5,
        "support_t": 15.0,
        "spread": 0.7,
        "inliers": 0.95,
        "decoy_inliers": 0.2,
        "overlap": 0.95,
        "n_overlap": 5000.0,
        "moved": 0.3,
        "converged": 1.0,
        "evidence": 2000.0,
    }
    return Figures(**good)


def test_good_figures_are_accepted_and_chance_is_refused() -> None:
    assert decide(figures_of_a_good_match()).accepted
    chance = replace(
        figures_of_a_good_match(), decoy_ratio=1.0, second_ratio=1.02, support=0.6, spread=0.0,
        inliers=0.3, decoy_inliers=0.3, prominence=2.0, support_t=2.0, effect=0.02,
    )  # fmt: skip
    verdict = decide(chance)
    assert not verdict.accepted
    assert verdict.confidence < 0.5
    assert not decide(Figures(*[0.0] * len(fields(Figures)))).accepted


def figure_sets() -> st.SearchStrategy[Figures]:
    """Draw figures over their whole ranges."""
    share, ratio = st.floats(0.0, 1.0), st.floats(0.1, 40.0)
    return st.builds(
        Figures,
        decoy_ratio=ratio,
        second_ratio=ratio,
        prominence=st.floats(0.0, 60.0),
        support=share,
        effect=share,
        support_t=st.floats(-3.0, 30.0),
        spread=st.floats(-2.0, 0.75),
        inliers=share,
        decoy_inliers=share,
        overlap=share,
        n_overlap=st.floats(10.0, 1e6),
        moved=st.floats(0.0, 3.0),
        converged=st.just(1.0),
        evidence=st.floats(0.0, 1e5),
        ground=st.none() | st.floats(0.0, 5.0),
        decoy_ground=st.none() | st.floats(0.0, 5.0),
        second_ground=st.none() | st.floats(0.0, 5.0),
        half_1=st.none() | ratio,
        half_2=st.none() | ratio,
    )


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    figure_sets(),
    st.sampled_from(["decoy_ratio", "second_ratio", "support", "inliers", "spread"]),
    st.floats(0.0, 1.0),
)
def test_more_for_the_pose_never_lowers_the_confidence(
    figures: Figures, name: str, more: float
) -> None:
    value = getattr(figures, name)
    top = {"decoy_ratio": 40.0, "second_ratio": 40.0, "spread": 0.75}.get(name, 1.0)
    better = replace(figures, **{name: value + more * (top - value)})
    before, after = decide(figures), decide(better)
    assert after.confidence >= before.confidence - 1e-12
    assert after.accepted or not before.accepted


@settings(max_examples=100, deadline=None, derandomize=True)
@given(figure_sets(), st.sampled_from(["half_1", "half_2", "ground", "moved"]), st.floats(0.2, 1.0))
def test_halves_that_fall_apart_ground_that_differs_and_points_that_wander_lower_the_confidence(
    figures: Figures, name: str, share: float
) -> None:
    whole = replace(figures, half_1=2.0, half_2=2.0, ground=0.1, decoy_ground=1.0, moved=0.1)
    worse = replace(whole, **{name: 2.0 * share if name in ("half_1", "half_2") else 0.1 / share})
    assert decide(worse).confidence <= decide(whole).confidence


def test_the_features_of_the_verdict_in_numbers() -> None:
    seen = features(
        replace(
            figures_of_a_good_match(), decoy_ratio=4.0, second_ratio=2.0, inliers=0.6,
            decoy_inliers=0.4, ground=0.05, decoy_ground=0.45, second_ground=0.25, moved=0.5,
            half_1=2.0, half_2=0.1,
        )
    )  # fmt: skip
    assert seen == pytest.approx(
        {
            "bias": 1.0,
            "ratios": math.log(8.0),
            "inliers": 2.0 * math.log(0.6 / 0.4),
            "ground": 0.5 * (math.log(0.6 / 0.2) + math.log(0.4 / 0.2)),
            "moved": math.log(1.5),
            "better_half": math.log(2.0),
            "weaker_half": math.log(0.25),  # bounded at a quarter
        }
    )
    # where nothing is measured nothing speaks
    assert features(figures_of_a_good_match())["ground"] == 0.0
    sure = replace(figures_of_a_good_match(), inliers=1.0, decoy_inliers=0.0)
    assert features(sure)["inliers"] == 3.0


@pytest.mark.parametrize(("other", "looks_closer"), [(0, False), (68, True)])
def test_a_doubtful_verdict_is_looked_at_closer_and_a_clear_one_is_not(
    other: int, looks_closer: bool
) -> None:
    rng = np.random.default_rng(4)
    base = look(make_place(4), rng)
    draft = look(make_place(4 + other), rng, roofs=False, edge=26.0)
    figures = match(base, draft).evidence
    for name in ("half_1", "half_2", "second_ground"):
        assert (name in figures) == looks_closer


@pytest.mark.parametrize(("other", "searches"), [(0, 1), (60, 2)])
def test_maps_that_clearly_match_are_told_at_a_glance_and_others_are_searched(
    other: int, searches: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans: list[SearchPlan] = []

    def spy(*args: Any, plan: SearchPlan, **options: Any) -> tuple[Peaks, Peaks]:
        plans.append(plan)
        return search_both(*args, plan=plan, **options)

    monkeypatch.setattr("commonmap.matching.match.search_both", spy)
    rng = np.random.default_rng(4)
    base = look(make_place(4), rng)
    draft = look(make_place(4 + other), rng, roofs=False, edge=26.0)
    assert match(base, draft).accepted == (other == 0)
    assert len(plans) == searches
    assert [max(plan.keep) for plan in plans] == [32, 256][:searches]


@pytest.mark.parametrize(
    ("best", "elsewhere", "mirrored", "told"),
    [
        (400.0, 100.0, 100.0, True),
        (400.0, 100.1, 50.0, False),
        (400.0, 50.0, 100.1, False),
        (100.0, 1.0, 1.0, True),
        (99.9, 1.0, 1.0, False),
    ],
)
def test_a_glance_tells_what_stands_four_times_above_chance(
    best: float, elsewhere: float, mirrored: float, told: bool
) -> None:
    def peaks(score: list[float], x: list[float]) -> Peaks:
        pose = np.column_stack([x, np.zeros((len(x), 2))])
        ones = np.ones(len(x))
        return Peaks(pose, np.array(score), ones, np.zeros(2), np.zeros((0, 2)), 0.5)

    # what lies within 3 m of the best pose is the best pose
    found = peaks([best, 0.9 * best, elsewhere], [0.0, 2.0, 4.0])
    assert is_told_at_a_glance(found, peaks([mirrored], [0.0])) == told
    assert not is_told_at_a_glance(peaks([], []), peaks([], []))


@pytest.mark.parametrize(
    "flaw",
    [{"converged": 0.0}, {"evidence": 99.0}, {"decoy_ratio": 1.0}, {"second_ratio": 1.2}],
)
def test_what_no_closer_look_could_make_up_for_gets_none(flaw: dict[str, float]) -> None:
    doubtful = replace(
        figures_of_a_good_match(), decoy_ratio=1.5, second_ratio=1.5, inliers=0.4,
        decoy_inliers=0.3, ground=0.1, decoy_ground=0.25, moved=1.0,
    )  # fmt: skip
    flawed = replace(doubtful, **flaw)
    assert is_open(doubtful)
    assert not is_open(flawed)
    # but where it may well be right all the same, how likely that is is looked at
    assert is_open(replace(flawed, moved=0.2))
    best = replace(flawed, half_1=4.0, half_2=4.0, second_ground=10.0)
    assert not decide(best).accepted


def test_the_halves_of_a_lucky_overlap_turn_the_verdict() -> None:
    doubtful = replace(
        figures_of_a_good_match(), decoy_ratio=3.0, second_ratio=2.5, prominence=15.0,
        inliers=0.6, decoy_inliers=0.3, ground=0.1, decoy_ground=0.25,
    )  # fmt: skip
    assert is_open(doubtful)
    assert decide(replace(doubtful, half_1=3.0, half_2=2.5)).accepted
    apart = decide(replace(doubtful, half_1=1.3, half_2=0.4))
    assert not apart.accepted
    assert "half" in apart.reason


@pytest.mark.parametrize(
    ("ratio", "told"), [(1.0, 0.5), (1.5, 0.962), (0.5, 0.004), (3.0, 1.0), (0.0, 0.0)]
)
def test_two_poses_are_told_apart_by_their_evidence_alone(ratio: float, told: float) -> None:
    sure = replace(
        figures_of_a_good_match(), second_ratio=ratio, ground=0.02, decoy_ground=2.0, half_1=4.0,
        half_2=4.0,
    )  # fmt: skip
    assert told_apart(ratio) == pytest.approx(told, abs=1e-3)
    assert decide(sure).confidence <= told + 1e-3
    assert decide(sure).accepted == (told >= 0.9)


def test_points_that_settle_elsewhere_turn_a_doubtful_verdict_and_are_named() -> None:
    doubtful = replace(
        figures_of_a_good_match(), decoy_ratio=4.0, second_ratio=4.0, inliers=0.7,
        decoy_inliers=0.45, ground=0.05, decoy_ground=0.3,
    )  # fmt: skip
    assert decide(doubtful).accepted
    wandered = decide(replace(doubtful, moved=1.8))
    assert not wandered.accepted
    assert "1.8 cells" in wandered.reason


@settings(max_examples=100, deadline=None, derandomize=True)
@given(figure_sets(), st.sampled_from([0.0, 1.0]))
def test_every_verdict_has_one_sentence_that_fits_it(figures: Figures, converged: float) -> None:
    verdict = decide(replace(figures, converged=converged))
    assert 0.0 <= verdict.confidence <= 1.0
    assert verdict.reason.startswith("accepted: " if verdict.accepted else "refused: ")
    assert "\n" not in verdict.reason
    assert ". " not in verdict.reason
    assert not verdict.reason.endswith(".")
    assert 20 < len(verdict.reason) < 250
    if not converged:
        assert not verdict.accepted


def test_a_pose_that_the_refinement_left_is_refused_however_good() -> None:
    verdict = decide(replace(figures_of_a_good_match(), converged=0.0))
    assert not verdict.accepted
    assert verdict.confidence <= 0.5
    assert "refinement" in verdict.reason


@pytest.mark.parametrize("name", ["decoy_ratio", "second_ratio"])
def test_no_better_than_chance_is_refused_however_good(name: str) -> None:
    assert not decide(replace(figures_of_a_good_match(), **{name: 1.0})).accepted
