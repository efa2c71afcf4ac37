"""The memory of the inference is bounded and known beforehand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from warmlens.config.file import load_config, merge, parse_config
from warmlens.config.yaml import read_yaml
from warmlens.inference.bootstrap import bootstrap_counts, quantiles_of_counts
from warmlens.inference.likelihood import BoundaryKernels
from warmlens.inference.memory import peak_mb, row_batches
from warmlens.stage_table import answer_memory_mb

from ..reliability import Outcome, fault

ROOT = Path(__file__).parents[2]
N, NUMBERS, TABLES, TRIALS = 20_000, 20, 400, 40

# What once held rows x tables of all fractions, in floating point, or 500 x rows distances of each kind.
LARGE = """\
import resource, sys
from pathlib import Path
import numpy as np
from warmlens.inference.acceptance import accept
from warmlens.inference.calibration import leave_one_out
from warmlens.inference.checks import cloud_check
from warmlens.inference.convergence import threshold_convergence
from warmlens.inference.information import information
from warmlens.inference.likelihood import likelihood_ratio
from warmlens.inference.table import Table

n, n_numbers, n_tables, n_trials = map(int, sys.argv[1:])
rng = np.random.default_rng(1)
m = rng.uniform(1.0, 5.0, n)
features = tuple(m[:, None] + rng.normal(size=(n, n_numbers // 2)) for _ in range(2))
prior = (1.0, 5.0), (13.0, 13.5)
table = Table(np.arange(n), m, rng.uniform(*prior[1], n), *prior, features, (np.full(n_numbers // 2, 4.0),) * 2)
_, counts = threshold_convergence(table, "max_rank", 0.05, n_tables, rng)
accepted = accept(table.distances(), "max_rank", 0.05, table.sample_id, rng).accepted
likelihood_ratio(m, accepted, counts, prior[0])
cloud_check(table)
information(m, prior[0], leave_one_out(table, "max_rank", 0.05, n_trials, rng, with_adjustment=True), rng)
if sys.platform == "darwin":
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
else:  # there ru_maxrss begins with the memory of the process that started this one
    print(int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 2**10)
"""


@fault("Machine", "a table of many samples", "20,000 samples, a child process that measures its peak", quick=True)
def test_peak_of_a_large_table_is_below_the_memory_that_is_asked_for(outcome: Outcome) -> None:
    words = [str(number) for number in (N, NUMBERS, TABLES, TRIALS)]
    done = subprocess.run([sys.executable, "-c", LARGE, *words], capture_output=True, text=True, check=True)
    assert 100.0 < float(done.stdout) < peak_mb(N, NUMBERS, TABLES, TRIALS)
    outcome.goes_on("it takes less memory than its rule asks for", "nothing")


def test_memory_that_a_campaign_asks_for_grows_with_its_samples() -> None:
    asked = []
    for n_samples in (2_483, 100_000):
        layer = {"campaign": {"n_samples": n_samples}}
        asked.append(answer_memory_mb(parse_config(merge(read_yaml(ROOT / "config.yaml"), layer))))
    assert 300 <= asked[0] <= 600 < 1000 <= asked[1] <= 2000
    one = load_config([ROOT / "config.yaml"])
    both = one.model_copy(update={"scan": one.scan.model_copy(update={"statistics": ["delta_r", "amplitude"]})})
    assert answer_memory_mb(both) >= answer_memory_mb(one)


def test_batches_change_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    m, weights = rng.uniform(1.0, 5.0, 200), rng.uniform(0.0, 1.0, 200)
    levels = np.array([0.05, 0.5])

    def numbers() -> list[np.ndarray]:
        counts = bootstrap_counts(np.abs(m - 3.0)[None], "max_rank", [0.1, 0.3], 30, np.random.default_rng(5))
        kernels = BoundaryKernels(np.linspace(1.0, 5.0, 9), m, 0.3, (1.0, 5.0))
        quantiles = [quantiles_of_counts(m, counts[1], levels, given) for given in (None, weights)]
        return [*counts[:], *quantiles, kernels.density(counts[0])]

    whole = numbers()
    monkeypatch.setattr("warmlens.inference.memory.BATCH_ELEMENTS", 1400)
    assert [batch.stop - batch.start for batch in row_batches(30, 200)] == [7, 7, 7, 7, 2]
    assert [batch.stop for batch in row_batches(30, 200, 5)] == [5, 10, 15, 20, 25, 30]
    for first, second in zip(whole, numbers(), strict=True):
        np.testing.assert_allclose(second, first, rtol=1e-14)
