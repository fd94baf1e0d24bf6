"""The simulated farm, on cases whose answers are known."""

import random

import pytest

from benchmarks.robustness import scale, scale_tables
from benchmarks.robustness.scale import Asset, Farm, Rates, Scenario, make, simulate

QUIET = Rates(spot_losses=0, crashes=0, hangs=0, failures=0, slow=0)
HOURLY = Scenario("an hour each", 3600.0, 0.0, 10, 2.0)


@pytest.fixture(autouse=True)
def equal_durations(monkeypatch):
    monkeypatch.setattr(scale, "spread", lambda: [1.0])


def test_an_asset_without_failures_takes_its_time():
    made = make(100.0, 2.0, 10.0, QUIET, Farm(), random.Random(0))
    assert made == Asset(200.0, 200.0, failed=False, again=False, hung=False)


def test_a_hung_asset_waits_for_the_time_limit_or_is_lost_with_its_worker():
    rates = QUIET._replace(hangs=1.0)
    made = make(100.0, 1.0, 10.0, rates, Farm(), random.Random(0))
    assert made == Asset(100.0 + 1800.0 + 10.0, 100.0, failed=False, again=False, hung=False)
    from_start = make(100.0, 1.0, 10.0, rates, Farm(resumes=False), random.Random(0))
    assert from_start.seconds == made.seconds + 50
    lost = make(100.0, 1.0, 10.0, rates, Farm(restarts_hung=False), random.Random(0))
    assert lost == Asset(50.0, 100.0, failed=True, again=False, hung=True)


def test_a_farm_without_failures_is_ideal():
    found = simulate(HOURLY, QUIET, Farm(), assets=100, seed=0)
    assert found["hours"] == pytest.approx(10) and found["worker_hours"] == pytest.approx(100)
    assert found["wasted_percent"] == pytest.approx(0) and found["dollars"] == pytest.approx(200)
    assert found["failed"] == found["made_again"] == 0


def test_checkpoints_save_most_of_what_losses_cost():
    rates = QUIET._replace(spot_losses=1.0, replacement=0.0)
    resumed, repeated = (
        simulate(HOURLY, rates, Farm(resumes=resumes), 2000, seed=0) for resumes in (True, False)
    )
    # with one loss an hour on average an hour's work takes e - 1 hours if it is repeated, or less
    # where an asset is begun again after the retries
    assert repeated["worker_hours"] / 2000 == pytest.approx(1.72, rel=0.1)
    assert resumed["worker_hours"] / 2000 == pytest.approx(1.02, rel=0.05)


def test_lost_workers_leave_assets_unmade():
    rates = QUIET._replace(hangs=0.5)
    found = simulate(HOURLY, rates, Farm(restarts_hung=False), 1000, seed=0)
    assert found["failed"] > 900


def test_the_driver_limit_is_where_its_time_is_full(monkeypatch):
    points = {"10 workers": [0.01], "1000 workers": [0.01], "2000 workers": [0.02]}
    monkeypatch.setattr(scale_tables, "values_of", lambda measured, unit: points)
    workers, seconds = scale_tables.driver_limit(HOURLY._replace(seconds=5.0, workers=1000))
    assert seconds == 0.01 and workers == pytest.approx(500, rel=0.01)
    workers, _ = scale_tables.driver_limit(HOURLY._replace(seconds=22.5))
    assert workers == pytest.approx(1500, rel=0.01)
