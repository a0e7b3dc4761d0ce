"""Choosing on made-up scenes, measured by the surveyor itself through a clock and an eye that know the truth.

Times bend a little from the additive model, errors from the power law, and frames as they come vary: what is chosen
must be near the best of all frames all the same, which are summed up one by one.
"""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

import warp_deferred as wd
from warp_deferred.fitting import report
from warp_deferred.fitting.choose import HELD_SHARE, Chooser
from warp_deferred.fitting.clock import Spread
from warp_deferred.fitting.curves import SAMPLE_POWER, sample_errors, scaled_errors
from warp_deferred.fitting.ladders import AMOUNTS, LADDERS, PIXEL_SAMPLES, SCALES, held_fields
from warp_deferred.fitting.model import Grid, Market
from warp_deferred.fitting.survey import Surveyor

NAMES = [ladder.name for ladder in LADDERS]
#: Absent in every made-up scene; others are there or not.
NEVER = ("depth_of_field", "motion_blur")


class World:
    """A scene's true times and errors, drawn at random about as scenes have them."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.geometry, self.pixels = rng.uniform(0.05, 0.3), rng.uniform(0.1, 0.4)
        self.beside, self.fxaa_ms = rng.uniform(0.0, 0.1), rng.uniform(0.01, 0.05)
        self.power, self.first = rng.uniform(0.6, 0.85), rng.uniform(0.02, 0.08)
        self.wobble = {n: rng.uniform(0.96, 1.04) for n in PIXEL_SAMPLES.values()}
        self.bend = {n: rng.uniform(0.98, 1.02) for n in PIXEL_SAMPLES.values()}
        self.fxaa = rng.uniform(0.6, 0.9)
        lost = rng.uniform(0.3, 0.9) * self.first
        self.lost = {scale: lost * (1.0 - side) * 2.0 for scale, side in SCALES.items()}
        self.kept = {scale: 1.0 + (1.0 - side) * rng.uniform(-0.5, 0.5) for scale, side in SCALES.items()}
        self.ray_ms = {name: rng.uniform(0.5, 5.0) for name in AMOUNTS}
        self.ray_error = {"ambient_visibility": rng.uniform(0.003, 0.006), "shadow": rng.uniform(0.005, 0.02)}
        self.ms, self.error = {}, {}
        self.absent = {*NEVER, *rng.permutation(["shadow", "bloom", "gbuffer"])[: rng.integers(1, 4)]}
        for ladder in LADDERS:
            worst = {"gbuffer": 0.002, "shade": 0.0005, "arithmetic": 3e-5, "shadow": 0.1}.get(ladder.name, 0.03)
            count = len(ladder.rungs)
            prices = np.sort(rng.uniform(0.0, 0.3, count)) * (0.05 if worst < 0.003 else 1.0)
            errors = np.sort(worst * rng.uniform(0.1, 1.0, count))[::-1]
            for rung, ms, error in zip(ladder.rungs, prices, errors, strict=True):
                self.ms[ladder.name, rung.name], self.error[ladder.name, rung.name] = ms, error
            if ladder.name not in AMOUNTS:
                self.error[ladder.name, ladder.rungs[-1].name] = 0.0
            self.ms[ladder.name, ladder.rungs[0].name] = 0.0

    def rays(self, name, rung, counts):
        """Rays of a rung that traces; 0 of others."""
        if not rung.startswith("ray_traced"):
            return 0
        return int(rung.partition(" ")[2] or counts.get(name, 256))

    def grid_error(self, scale, rung):
        n = PIXEL_SAMPLES[rung]
        own = self.first * n**-self.power * self.wobble[n] * (self.fxaa if rung == "fxaa" else 1.0)
        return math.hypot(self.lost[scale], self.kept[scale] * own)

    def time(self, choice, counts):
        n, share = PIXEL_SAMPLES[choice["anti_aliasing"]], SCALES[choice["scale"]] ** 2
        once, each = self.fxaa_ms * share * (choice["anti_aliasing"] == "fxaa"), self.geometry + self.pixels * share
        for ladder in LADDERS:
            if ladder.name in choice:
                rays = self.rays(ladder.name, choice[ladder.name], counts)
                ms = self.ray_ms[ladder.name] * rays if rays else self.ms[ladder.name, choice[ladder.name]]
                if ladder.part == "sample":
                    each += ms * share
                else:
                    once += ms * share
        return once + self.beside * (n > 1) * share + n * each * self.bend[n]

    def squares(self, choice, counts):
        """Squared error of each part of a frame."""
        n = PIXEL_SAMPLES[choice["anti_aliasing"]]
        result = {"grid": self.grid_error(choice["scale"], choice["anti_aliasing"]) ** 2}
        for name in NAMES:
            if name in choice:
                rays = self.rays(name, choice[name], counts)
                error = self.error[name, choice[name]]
                if rays:
                    power = 0.55 if name == "ambient_visibility" else 0.8
                    error = self.ray_error[name] * (4 / rays) ** power
                    error /= math.sqrt(n) if name == "ambient_visibility" else 1.0
                result[name] = error**2
        return result

    def distance(self, one, other):
        """RMSE of two pictures: parts that are made alike do not differ."""
        mine, theirs = self.squares(*one), self.squares(*other)
        made = [
            {n: (rung, self.rays(n, rung, counts)) for n, rung in choice.items()} for choice, counts in (one, other)
        ]
        alike = {name: made[0].get(name) == made[1].get(name) for name in mine}
        alike["grid"] = all(one[0][key] == other[0][key] for key in ("scale", "anti_aliasing"))
        return math.sqrt(sum(mine[name] + theirs[name] for name in mine if not alike[name]))


class Probe:
    """Looks at a world in place of a renderer."""

    def __init__(self, world, seed):
        self.world, self.rng, self.plans, self.now_s, self.moves = world, np.random.default_rng(seed), 0, 0.0, False
        self.device = SimpleNamespace(is_cuda=True)
        scene = SimpleNamespace(lights=range(100))
        self.renderer = SimpleNamespace(outputs={"display"}, scene=scene)

    def look(self, frame):
        self.frame, self.plans = frame, self.plans + 1

    @property
    def plan(self):
        runs = {ladder.needs: ladder.name not in self.world.absent for ladder in LADDERS}
        runs["shade"] = True
        reports = [SimpleNamespace(name=name, runs=value, reason="not there") for name, value in runs.items()]
        request = SimpleNamespace(
            settings=wd.Settings(), lens=SimpleNamespace(aperture=False, shutter=False), moving=""
        )
        return SimpleNamespace(reports=lambda measure: reports, request=request)

    def picture(self):
        return self.frame

    def rmse(self, reference, picture=None):
        return self.world.distance(picture or self.frame, reference)

    def price(self):
        return self.world.time(*self.frame) * self.rng.uniform(0.997, 1.003)

    def replays(self):
        return Spread.of([self.price() for _ in range(9)])

    def in_motion(self):
        return self.price() + 0.01

    def frames(self, first, count):
        return [(self.world.time(*self.frame) + 0.01) * self.rng.uniform(0.995, 1.005) for _ in range(count)]

    def animate(self, moment):
        pass


class Eye(Surveyor):
    """A surveyor whose settings are plain choices."""

    def at(self, choice, counts=None):
        full = {"scale": "off", "anti_aliasing": "off"}
        full |= {ladder.name: ladder.base for ladder in self.ladders if self.sold(ladder)}
        return full | {k: v for k, v in choice.items() if k in full}, dict(counts or {})


def market_of(seed, budget=None, held=()):
    world = World(seed)
    settings = wd.Settings().with_values([*held, *(["gbuffer.rung=compact"] if "gbuffer" in world.absent else [])])
    eye = Eye(Probe(world, seed), settings, held_fields(settings), budget, None)
    survey = eye.measure()
    return world, eye, survey, Market(survey.grid, survey.ladders)


def best_of(world, eye, survey, truth, budget):
    """Least error of all frames that keep a budget, by trying each one."""
    offers = [[(ladder.name, offer.rung) for offer in ladder.offers] for ladder in survey.ladders]
    best = math.inf
    for (scale, rung), *rungs in itertools.product(survey.grid.errors, *offers):
        frame = eye.at({"scale": scale, "anti_aliasing": rung, **dict(rungs)})
        if world.time(*frame) + 0.01 <= budget:
            best = min(best, world.distance(frame, truth))
    return best


@pytest.mark.parametrize("seed", range(12))
def test_the_choice_is_near_the_best_of_all_frames_and_near_the_budget(seed):
    base = World(seed).geometry + World(seed).pixels
    budget = base * float(np.random.default_rng(1000 + seed).uniform(1.2, 8.0))
    world, eye, survey, market = market_of(seed, budget)
    looks = eye.probe.plans
    truth = eye.truth(survey)
    buyer = Chooser(market, eye, truth, budget, None, survey.whole_samples)
    chosen = buyer.choose()
    assert chosen.held >= HELD_SHARE
    assert chosen.error <= 1.15 * best_of(world, eye, survey, truth, budget)
    # Little of the budget is left, or the account says why.
    spent = chosen.unseen.median / budget
    told = report.unspent(buyer, chosen)
    why = ": nothing" if chosen.unseen.p95 < 0.9 * budget else " by the median, for frames vary"
    assert told == "" if spent >= 0.9 else told.startswith(f"{1.0 - spent:.0%} of the budget is left{why}"), told
    assert looks <= 45 and eye.probe.plans - looks <= 14


def test_what_is_left_of_a_budget_could_buy_next_to_nothing():
    shares = []
    for seed in range(12, 32):
        budget = 0.5 + 0.25 * (seed - 12)
        world, eye, survey, market = market_of(seed, budget)
        truth = eye.truth(survey)
        chosen = Chooser(market, eye, truth, budget, None, survey.whole_samples).choose()
        if chosen.held < HELD_SHARE:
            continue
        shares.append(chosen.unseen.median / budget)
        if shares[-1] < 0.9:
            assert chosen.error <= 1.05 * best_of(world, eye, survey, truth, 0.99 * budget)
    assert len(shares) >= 15 and np.median(shares) > 0.9


@pytest.mark.parametrize(("taken", "bought"), [(3.9, "samples_4"), (4.02, "off")])
def test_what_may_be_predicted_too_high_is_looked_at_where_it_promises_much(taken, bought):
    times = {"off": 1.0, "samples_4": taken}
    looks = []
    probe = SimpleNamespace(
        device=SimpleNamespace(is_cuda=True), now_s=0.0, animate=lambda moment: None,
        rmse=lambda truth: {"off": 0.1, "samples_4": 0.02}[looks[-1]],
        frames=lambda first, count: [times[looks[-1]]] * count,
    )  # fmt: skip
    surveyor = SimpleNamespace(
        probe=probe, samples=64, look=lambda title, choice: looks.append(choice["anti_aliasing"])
    )
    errors = {("off", "off"): 0.1, ("off", "samples_4"): 0.02, ("off", "samples_8"): 0.01}
    market = Market(Grid({("off", 1): 1.0, ("off", 4): 4.08, ("off", 8): 8.2}, errors), ())
    chosen = Chooser(market, surveyor, None, 4.0, None, 64).choose()
    # Two parts in a hundred past the budget are looked at, twice the budget is not.
    assert chosen.choice["anti_aliasing"] == bought and chosen.held == 1.0
    assert set(looks) == {"off", "samples_4"} and looks.count("samples_4") == (2 if bought == "samples_4" else 1)


def test_every_number_of_samples_is_for_sale_from_a_few_looks():
    world, eye, survey, market = market_of(3)
    assert {rung for scale, rung in survey.grid.errors if scale == "off"} == set(PIXEL_SAMPLES)
    for rung, n in PIXEL_SAMPLES.items():
        if n < 64:
            assert survey.grid.errors["off", rung] == pytest.approx(world.grid_error("off", rung), rel=0.25)
        frame = eye.at({"anti_aliasing": rung})
        predicted = survey.grid.time("off", n) + (survey.grid.fxaa_ms if rung == "fxaa" else 0.0)
        assert predicted == pytest.approx(world.time(*frame), rel=0.06)
    traced = next(ladder for ladder in survey.ladders if ladder.name == "ambient_visibility")
    assert [offer.rung for offer in traced.offers if offer.estimated][:3] == [
        "ray_traced 2",
        "ray_traced 3",
        "ray_traced 4",
    ]
    assert traced.offer("ray_traced 8").ms == pytest.approx(8 * world.ray_ms["ambient_visibility"], rel=0.1)
    choice = market.choice(0) | {"anti_aliasing": "samples_4", "ambient_visibility": "ray_traced 4"}
    one = market.predict(choice | {"anti_aliasing": "off"})
    assert market.predict(choice)[1] < one[1]


def test_fast_arithmetic_is_for_sale_beside_the_precise_one_that_all_others_are_measured_with():
    world, eye, survey, _ = market_of(4)
    ladder = next(ladder for ladder in survey.ladders if ladder.name == "arithmetic")
    fast, precise = ladder.offers
    # Prices are differences of frames that vary by 0.3 %.
    saved = world.ms["arithmetic", "precise"] - world.ms["arithmetic", "fast"]
    assert (precise.ms, precise.error) == (0.0, 0.0) and fast.rung == "fast"
    assert fast.ms == pytest.approx(-saved, abs=0.01 * world.time(*eye.at({}))) and 0.0 < fast.error < 1e-4
    assert eye.at({})[0]["arithmetic"] == "precise"
    assert "arithmetic" in market_of(4, held=["shade.arithmetic=fast"])[1].fixed


def test_amounts_that_are_set_by_hand_are_held_and_the_rest_is_for_sale():
    _, eye, survey, _ = market_of(1, held=["ambient_visibility.steps=2", "shadow.samples=64"])
    rungs = {ladder.name: [rung.name for rung in ladder.rungs] for ladder in eye.ladders}
    assert "gtao" in rungs["ambient_visibility"] and "gtao 1 x 8" not in rungs["ambient_visibility"]
    assert "ray_traced 4" in rungs["ambient_visibility"] and "ray_traced 4" not in rungs["shadow"]
    assert "ambient_visibility" in {ladder.name for ladder in survey.ladders}


# ---- what was not measured


def test_errors_between_two_numbers_lie_on_the_power_that_joins_them():
    truth = {n: 0.05 * n**-0.7 for n in (1, 2, 4, 8, 16, 32)}
    found = sample_errors({1: truth[1], 4: truth[4], 16: truth[16], 64: 0.0}, truth)
    assert found == pytest.approx(truth) and sample_errors({64: 0.0, 4: 0.1}, [64])[64] == 0.0
    assert sample_errors({4: 0.1}, [16])[16] == pytest.approx(0.1 * 4**-SAMPLE_POWER)
    # Noise does not make many samples worse than few, nor a picture perfect.
    assert sample_errors({1: 0.01, 4: 0.02}, [16])[16] == 0.02
    assert sample_errors({1: 1.0, 4: 1e-6}, [16])[16] == pytest.approx(1e-6 / 4)


def test_errors_of_smaller_sizes_are_what_is_lost_and_what_samples_leave():
    full = {"off": 0.05, "fxaa": 0.04, "samples_4": 0.02, "samples_16": 0.008}
    truth = {rung: math.hypot(0.015, 1.2 * error) for rung, error in full.items()}
    own = {rung: truth[rung] for rung in ("fxaa", "samples_4")}
    assert scaled_errors(full, own, full) == pytest.approx(truth)
    # One look alone: what it does not explain is lost.
    assert scaled_errors(full, {"fxaa": 0.05}, full)["samples_16"] == pytest.approx(math.hypot(0.03, 0.008))


def test_samples_that_a_frame_takes_in_any_case_leave_one_rung():
    errors = {("off", rung): 0.05 * n**-0.7 * (0.8 if rung == "fxaa" else 1.0) for rung, n in PIXEL_SAMPLES.items()}
    market = Market(Grid({("off", 1): 1.0, ("off", 16): 16.0}, errors, fxaa_ms=0.1, least=16), ())
    # Up to the sixteen that are taken in any case, only they themselves are for sale.
    assert {market.choice(k)["anti_aliasing"] for k in range(len(market))} == {
        rung for rung, n in PIXEL_SAMPLES.items() if n >= 16
    }
