"""The same UR5 carries the same rod in PyBullet and in MuJoCo: what both engines find agrees."""

import numpy as np
import pytest
from two_engines import CASES, apart, at_rest, carried


@pytest.mark.study
@pytest.mark.parametrize("case", ["hanging", "pulled by 0.3 N", "on a fixed block", "on a sprung block"])
def test_tip_and_base_wrench_agree_within_one_percent(case: str) -> None:
    assert case in CASES
    found = [at_rest(engine, case, 200) for engine in ("PyBullet", "MuJoCo")]
    costs = apart(*found)
    assert max(costs.values()) < 0.01, costs
    # nothing agrees by being nothing: the weight hangs on the flange, and what pushes is felt
    weight = np.array([0.0, 0.0, -0.1 * carried()[0].length * 9.81])
    for result in found:
        beside = result.wrench[:3] - weight
        expected = {"hanging": 0.0, "pulled by 0.3 N": 0.3}.get(case)
        if expected is None:
            assert np.linalg.norm(beside) > 0.1
        else:
            assert np.linalg.norm(beside) == pytest.approx(expected, abs=1e-6)
        assert np.linalg.norm(result.wrench[3:]) > 0.003
